"""What of an episode is played back, and how fast. Imports nothing heavy."""

from collections.abc import Sequence
from dataclasses import dataclass

from bridge.errors import UsageError, refuse_outside
from bridge.wire.keys import topic_pattern


@dataclass(frozen=True, kw_only=True)
class PlaybackConfig:
    """How an episode is played back."""

    rate: float = 1.0
    """Times as fast as it was recorded."""
    start_s: float = 0.0
    """Begin so many seconds into the episode; what was latched before is sent first."""
    topics: tuple[str, ...] = ()
    """Only these topics; * stands for one part of a name, ** for any number of them."""
    shared_memory_mb: int = 0
    """Send images to a recorder on this machine through so much shared memory [MB]."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense."""
        refuse_outside(self, {"rate": (0.001, 1000.0), "start_s": (0.0, float("inf"))})
        refuse_outside(self, {"shared_memory_mb": (0, 100_000)})


def choose_topics(patterns: Sequence[str], there: Sequence[str]) -> list[str]:
    """Return the topics that a pattern names; all without one."""
    if not patterns:
        return list(there)
    chosen: set[str] = set()
    for pattern in patterns:
        matches = topic_pattern(pattern).fullmatch
        found = {topic for topic in there if matches(topic)}
        if not found:
            more = f" and {len(there) - SHOWN} more" if len(there) > SHOWN else ""
            listed = f"There are: {', '.join(there[:SHOWN])}{more}."
            raise UsageError(f"--topics {pattern!r} names no topic of the episode. {listed}")
        chosen |= found
    return [topic for topic in there if topic in chosen]


SHOWN = 30
"""Topics that an error lists."""
