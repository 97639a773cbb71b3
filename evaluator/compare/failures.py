"""What kind of failure each trial is: cause, stage, bodies, and where its object started."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from evaluator.compare.measure import grouped
from evaluator.compare.rows import TrialRow
from evaluator.compare.stages import NO_STAGE, NOT_LABELLED, first_failed_stage

TWIN_SUCCEEDS = "the twin succeeds"
"""Stands for the cause of a recorded failure that the twin did not foretell."""
NO_ANSWER = "no answer of the twin"
UNNAMED = "no cause named"
LEAST_SPREAD_M = 0.02
"""Starts that lie closer together than this along an axis are not told apart by it."""
FEWEST = 4
"""Located starts of a task below which halves say nothing."""


@dataclass(frozen=True, kw_only=True)
class FailureKind:
    """How a failure is sorted; an empty part is not known."""

    cause: str
    """Of the first factor that failed in the twin; else that the twin did not fail, and in what
    planned, executed and recorded part first."""
    stage: str
    """Labelled as the first that failed; else the one in which the twin failed."""
    bodies: str
    """What touched, came too close or was lost in the twin, in the order of the alphabet."""


def failure_kind(row: TrialRow) -> FailureKind | None:
    """Sort one trial; None for one that failed on neither side."""
    if row.twin is False:
        cause = row.failing_cause or row.first_failing or UNNAMED
    elif row.recorded is False:
        cause = TWIN_SUCCEEDS if row.twin else NO_ANSWER
        if row.twin and row.divergence:
            cause = f"{TWIN_SUCCEEDS}: {row.divergence}"
    else:
        return None
    foretold = row.twin is False
    labelled = first_failed_stage(row) if row.recorded is False else NOT_LABELLED
    stage = row.failing_stage if foretold else ""
    return FailureKind(
        cause=cause,
        stage=stage if labelled in (NOT_LABELLED, NO_STAGE) else labelled,
        bodies=" and ".join(sorted(row.failing_bodies)) if foretold else "",
    )


def start_regions(rows: Sequence[TrialRow]) -> dict[str, str]:
    """Say of each trial where its object started: near or far, left or right, by episode.

    In each task it is the object whose start varies most. Halves are parted at the median of the
    task's trials, along x (ahead) and y (left) of the robot's base.
    """
    tasks = grouped(rows, lambda row: row.task).values()
    return {name: text for group in tasks for name, text in _regions(group)}


def _regions(rows: Sequence[TrialRow]) -> Iterator[tuple[str, str]]:
    names = sorted({name for row in rows for name in row.start_positions_m})
    places = {
        name: np.array([r.start_positions_m[name][:2] for r in rows if name in r.start_positions_m])
        for name in names
    }
    places = {name: p_m for name, p_m in places.items() if len(p_m) >= FEWEST}
    if not places:
        return
    moved = max(places, key=lambda name: float(places[name].std(axis=0).max()))
    p_m = places[moved]
    middle, varies = np.median(p_m, axis=0), p_m.std(axis=0) > LEAST_SPREAD_M
    for row in rows:
        if moved in row.start_positions_m and varies.any():
            x, y, _ = row.start_positions_m[moved]
            parts = [("near", "far")[int(x > middle[0])]] if varies[0] else []
            parts += [("right", "left")[int(y > middle[1])]] if varies[1] else []
            yield row.episode, f"{moved} {' '.join(parts)}"
