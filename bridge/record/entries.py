"""What goes through the recorder's queues: messages, counts of what was left out, commands."""

from collections.abc import Callable
from dataclasses import dataclass, field

from bridge.clock import NS_PER_S
from bridge.record.inspection import Finding
from bridge.record.sequence import Step
from bridge.wire.session import WireSample

MAX_WARNINGS = 1000


@dataclass(slots=True)
class Item:
    """A message that was taken in; the encoder of its stream may put a smaller one in its place."""

    sample: WireSample
    """What is written."""
    step: Step
    ticket: int
    """Place in the order of arrival."""
    type_name: str
    """Of what is written; "" when nobody knows."""
    size: int
    """Bytes as they came over the wire."""
    is_bulk: bool
    """Takes room from the budget of images, not from that of small messages."""
    finding: Finding | None = None
    """None when nobody has looked yet."""
    reduced: bool = False
    """Of less than the wanted quality."""
    extra: WireSample | None = None
    """Made here of this message, and written behind it; in no account."""
    for_preview: bool = False
    """Nobody records; only a preview is made of it."""

    @property
    def received_ns(self) -> int:
        """When it arrived, by the recorder's clock."""
        return self.sample.received_ns


@dataclass(kw_only=True, slots=True)
class DropCount:
    """What was not taken in of one topic in one second."""

    messages: int = 0
    shed: int = 0
    gaps: int = 0
    fills: list[int] = field(default_factory=list)
    """Tickets at which messages that then came late had been booked as missing."""


@dataclass(kw_only=True, slots=True)
class Dropped:
    """Messages not taken in between two entries."""

    ticket: int
    received_ns: int
    counts: dict[tuple[str, int], DropCount] = field(default_factory=dict)
    """By (topic, second of reception)."""
    warnings: dict[str, None] = field(default_factory=dict)

    def warn(self, text: str) -> None:
        """Remember a remark, once."""
        if text not in self.warnings and len(self.warnings) < MAX_WARNINGS:
            self.warnings[text] = None


@dataclass(kw_only=True, slots=True)
class Command:
    """Something to do at this place in the stream."""

    action: Callable[["Command"], None]
    received_ns: int
    is_barrier: bool = True
    """Waits until every image received before it went through its encoder."""
    ticket: int = 0
    images_before: int = 0
    number: int = 0


Entry = Item | Dropped | Command
"""What the writer thread takes, in order."""


def second_of(stamp_ns: int) -> int:
    """The whole second a stamp lies in."""
    return stamp_ns // NS_PER_S
