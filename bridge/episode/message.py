"""A message on its way into an episode, whether over the wire or straight into a file."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class StampedMessage:
    """One serialised message with the time its source made it."""

    topic: str
    type_name: str
    data: bytes
    stamp_ns: int
