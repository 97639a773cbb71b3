"""What of an episode is played back, how fast, and under which names. Imports nothing heavy."""

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from bridge.errors import UsageError, refuse_outside
from bridge.wire.keys import topic_pattern

ARROW = ":="
"""Between the old and the new name of a topic, as ROS 2 writes it."""


@dataclass(frozen=True, kw_only=True)
class PlaybackConfig:
    """How an episode is played back."""

    rate: float = 1.0
    """Times as fast as it was recorded."""
    start_s: float = 0.0
    """Begin so many seconds into the episode; what was latched before is sent first."""
    topics: tuple[str, ...] = ()
    """Only these topics; * stands for one part of a name, ** for any number of them."""
    remap: tuple[str, ...] = ()
    """OLD:=NEW sends a topic, or all below a name (/lab:=/lab2), under another one."""
    shared_memory_mb: int = 0
    """Send images to a recorder on this machine through so much shared memory [MB]."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense, and names that are not of the form OLD:=NEW."""
        refuse_outside(self, {"rate": (0.001, 1000.0), "start_s": (0.0, float("inf"))})
        refuse_outside(self, {"shared_memory_mb": (0, 100_000)})
        for pair in self.remap:
            old, arrow, new = pair.partition(ARROW)
            if not (arrow and old and new.startswith("/") and len(new) > 1):
                raise UsageError(
                    f"--remap {pair!r} is not of the form OLD{ARROW}/NEW, "
                    f"for example /lab/event{ARROW}/twin/event."
                )


def choose_topics(patterns: Sequence[str], there: Sequence[str]) -> list[str]:
    """Return the topics that a pattern names; all without one.

    Raises:
        UsageError: When a pattern names none of them, with those that are there.
    """
    if not patterns:
        return list(there)
    chosen: set[str] = set()
    for pattern in patterns:
        matches = topic_pattern(pattern).fullmatch
        found = {topic for topic in there if matches(topic)}
        if not found:
            raise UsageError(f"--topics {pattern!r} names no topic of the episode. {_hint(there)}")
        chosen |= found
    return [topic for topic in there if topic in chosen]


def rename_topics(pairs: Sequence[str], chosen: Sequence[str]) -> dict[str, str]:
    """Return the name under which each topic is sent; the longest OLD that fits counts.

    Raises:
        UsageError: When an OLD fits no topic, or two topics would get the same name.
    """
    names = {topic: topic for topic in chosen}
    olds = [pair.partition(ARROW) for pair in pairs]
    for old, _, new in sorted(olds, key=lambda each: len(each[0])):
        prefix = old.rstrip("/")
        found = [topic for topic in chosen if topic == prefix or topic.startswith(f"{prefix}/")]
        if not found:
            close = get_close_matches(old, chosen, 1, 0.0)
            raise UsageError(
                f"--remap {old}{ARROW}{new}: no topic that is played has this name or begins with "
                f"it; the nearest is {close[0]}."
            )
        for topic in found:
            names[topic] = new.rstrip("/") + topic[len(prefix) :]
    by_name: dict[str, str] = {}
    for topic, name in names.items():
        if name in by_name:
            raise UsageError(
                f"{by_name[name]} and {topic} would both be sent as {name}. "
                "Give one of them another name with --remap, or leave it out with --topics."
            )
        by_name[name] = topic
    return names


def _hint(there: Sequence[str]) -> str:
    shown = ", ".join(there[:SHOWN])
    more = len(there) - SHOWN
    return f"There are: {shown}" + (f" and {more} more." if more > 0 else ".")


SHOWN = 30
"""Topics that an error lists."""
