"""What depth says about the poses of one camera, whatever it was compared with."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from twin.scene.frames.thumb import Meeting
from twin.scene.learn.convention import Convention

GOOD = 0.5
"""With this share of the overlap agreeing, poses and depth belong together."""
CLEARLY_BETTER = 0.2
MIN_OVERLAP = 0.05
"""With less, depth says nothing about the poses."""
SOLID_OVERLAP = 0.2
"""Frames near in time overlap at least by this much if their poses are read rightly."""


class Score(NamedTuple):
    """How well depth fits under one reading of the poses."""

    agreement: float
    """Share of the overlapping depth that agrees."""
    overlap: float
    """Share of a frame's measurements that another frame sees too; mean over what was compared."""


@dataclass(frozen=True, kw_only=True)
class PoseReport:
    """What the depth says about the poses of one camera."""

    num_pairs: int
    """Pairs of frames between which the camera visibly moved; 0: nothing could be checked."""
    agreement: float | None
    """Share of the overlapping depth that agrees under the recorded poses."""
    overlap: float
    """Share of a frame's measurements that another frame sees too; mean over pairs."""
    better: Convention | None = None
    better_agreement: float | None = None
    """A convention under which they clearly fit, where the recorded one does not."""

    @property
    def fits(self) -> bool:
        """Whether the recorded poses can be believed as far as the depth tells."""
        return self.agreement is None or self.agreement >= GOOD

    @property
    def is_sure(self) -> bool:
        """Whether depth was there to judge them by, and they fit."""
        return self.agreement is not None and self.fits

    def remark(self) -> str:
        """One sentence about what is wrong; empty when nothing is."""
        if self.better is not None and self.better_agreement is not None:
            return (
                f"only {100 * (self.agreement or 0.0):.0f} % of the depth agrees between views, "
                f"but {100 * self.better_agreement:.0f} % would under another reading: "
                f"{self.better.describe()}"
            )
        if self.agreement is not None and not self.fits:
            return (
                f"only {100 * self.agreement:.0f} % of the depth agrees between views, and no "
                "known convention makes it better: wrong poses, clocks that differ, or a scene "
                "that moved"
            )
        if self.num_pairs and self.overlap < MIN_OVERLAP:
            return "its views hardly overlap: poses cannot be checked, and edges will not meet"
        return ""


def score_of(met: Sequence[Meeting]) -> Score:
    """Agreement and overlap of all that was compared, at least one; it counts by its overlap."""
    total = sum(item.overlap for item in met)
    agreed = sum(item.agreement * item.overlap for item in met)
    return Score(agreement=agreed / total if total > 0 else 0.0, overlap=total / len(met))


def plain_report(num_pairs: int, recorded: Score) -> PoseReport:
    """Report on poses as they were recorded; no agreement where views hardly overlap."""
    return PoseReport(
        num_pairs=num_pairs,
        agreement=recorded.agreement if recorded.overlap >= MIN_OVERLAP else None,
        overlap=recorded.overlap,
    )


def best_of(
    conventions: Iterable[Convention], score: Callable[[Convention], Score]
) -> tuple[Convention, float]:
    """The convention under which most depth agrees, and how much; 0 without solid overlap."""
    scored = []
    for convention in conventions:
        agreement, overlap = score(convention)
        scored.append((convention, agreement if overlap >= SOLID_OVERLAP else 0.0))
    return max(scored, key=lambda item: item[1])


def is_clearly_better(agreement: float, recorded: PoseReport) -> bool:
    """Whether poses fit with this agreement, and clearly better than as they were recorded."""
    return agreement >= GOOD and agreement >= (recorded.agreement or 0.0) + CLEARLY_BETTER
