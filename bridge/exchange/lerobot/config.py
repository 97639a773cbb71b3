"""How a run becomes a LeRobot dataset. Imports nothing heavy."""

from dataclasses import dataclass
from typing import Literal

from bridge.errors import refuse_outside


@dataclass(frozen=True, kw_only=True)
class LeRobotConfig:
    """How a run becomes a dataset."""

    fps: int | None = None
    """Rows per second; the rate of the first camera if not given, 30 without cameras."""
    action: Literal["auto", "plan", "next-state"] = "auto"
    """plan: what the executed plan commands for the next row; auto: that if all trials have it."""
    episodes: tuple[str, ...] = ()
    """Only the episodes with these ids, of any kind."""
    crf: int = 23
    """Quality of the H.264 video, lower is better."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense."""
        refuse_outside(self, {"fps": (1, 1000), "crf": (0, 51)})
