"""One motion against another, summed up: recorded against replays, lag apart from path.

Two questions. Recorded against the planned replay: what the controller made of the command.
Recorded against the executed replay: how well kinematics and base calibration fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.clock import NS_PER_S
from bridge.episode.reader import Episode
from bridge.errors import GstError
from evaluator.compare import measure
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import find_lag_s, pose_errors, position_errors
from evaluator.motion_measurements import MOTIONS
from evaluator.result import Cell, Measurement, Table
from evaluator.run_reader.tracks import Tracks, read_tracks

SAME_CLOCK_NS = 2 * NS_PER_S
"""A replay whose stamps start this close to the execution uses the cell's clock."""
PLANNED, EXECUTED = "planned", "executed"


@dataclass(frozen=True, kw_only=True)
class MotionErrors:
    """How far one motion of the arm lies from another one."""

    aligned_by: str
    """``stamps``: one clock; ``starts``: clocks of their own, laid over each other where the
    execution starts."""
    position_mean_m: float
    """At the same instants: what the lag and the path make together."""
    end_point_m: float
    """At the last instant both know."""
    rotation_mean_rad: float
    lag_s: float | None = None
    """By how much the first comes later, whatever rigid motion lies between; None where it cannot
    be found."""
    path_mean_m: float
    """Mean distance after that lag is taken out: another path, not a later one."""
    path_max_m: float


@dataclass(frozen=True, kw_only=True)
class MotionSummary(MotionErrors):
    """How far a recorded motion lies from a replayed one."""

    episode: str
    task: str
    condition: str
    against: str
    """Which replay it is compared with: ``planned`` or ``executed``."""


def summarise_motions(
    recorded: Episode, replays: Mapping[str, Episode], *, plan_id: str
) -> tuple[MotionSummary, ...]:
    """Compare a recorded execution with its replays; what shares no tool poses is left out."""
    own, info = read_tracks(recorded, plan_id), recorded.info
    who: dict[str, Any] = {"episode": info.id, "task": info.task, "condition": info.condition}
    found = []
    for against in (PLANNED, EXECUTED):
        if against in replays:
            try:
                errors = compare_tracks(own, read_tracks(replays[against], plan_id))
            except UndefinedStatisticError:
                continue
            found.append(MotionSummary(**who, against=against, **vars(errors)))
    return tuple(found)


def compare_tracks(mine: Tracks, other: Tracks) -> MotionErrors:
    """Compare two motions on one clock, first at equal times, then with the lag taken out.

    Where no lag can be found the path is that of equal instants.
    """
    aligned_by, mine, other = on_one_clock(mine, other)
    if mine.tool is None or other.tool is None:
        raise _no_tool()
    errors = pose_errors(mine.tool, other.tool)
    lag_s, path_m = None, errors.position_m
    same_m = mine.tool.at(errors.stamps_ns).p_m
    try:
        lag_s = find_lag_s(errors.stamps_ns, same_m, other.tool)
        later = other.tool.shifted(round(lag_s * NS_PER_S))
        path_m = position_errors(errors.stamps_ns, same_m, later)
    except UndefinedStatisticError:
        pass
    return MotionErrors(
        aligned_by=aligned_by,
        position_mean_m=float(errors.position_m.mean()),
        end_point_m=float(errors.position_m[-1]),
        rotation_mean_rad=float(errors.rotation_rad.mean()),
        lag_s=lag_s,
        path_mean_m=float(path_m.mean()),
        path_max_m=float(path_m.max()),
    )


def _no_tool() -> UndefinedStatisticError:
    return UndefinedStatisticError(statistic="motion", reason="no tool poses on one clock")


def on_one_clock(mine: Tracks, other: Tracks) -> tuple[str, Tracks, Tracks]:
    """Return by what two motions are aligned, and both on one clock, the first cut to its plan."""
    mine = mine.cut()
    if mine.tool is None or other.tool is None or mine.started_ns is None:
        raise _no_tool()
    gap_ns = mine.started_ns - int(other.tool.stamps_ns[0])
    if abs(gap_ns) <= SAME_CLOCK_NS:
        return "stamps", mine, other
    return "starts", mine, other.shifted(gap_ns)


def distance_over_time(
    recorded: Path, replay: Path, plan_id: str
) -> tuple[Float[np.ndarray, " num_samples"], Float[np.ndarray, " num_samples"]] | None:
    """Return seconds since the start of an execution, and how far the replayed tool was off [m].

    None where the files do not allow it.
    """
    try:
        mine, other = (read_tracks(Episode.open(path), plan_id) for path in (recorded, replay))
        _, mine, other = on_one_clock(mine, other)
        if mine.started_ns is None or mine.tool is None or other.tool is None:
            return None
        errors = pose_errors(mine.tool, other.tool)
    except GstError:  # a file has gone or changed since it was listed, or they share no instant
        return None
    return (errors.stamps_ns - mine.started_ns) / NS_PER_S, errors.position_m


Groups = Mapping[str, Sequence[MotionSummary]]
"""By what the motions are held against: planned or executed."""


COLUMNS = (
    ("lag (ms)", measure.milliseconds, "lag_s"),
    ("path (mm)", measure.millimetres, "path_mean_m"),
    ("path, largest (mm)", measure.millimetres, "path_max_m"),
    ("at equal times (mm)", measure.millimetres, "position_mean_m"),
    ("end point (mm)", measure.millimetres, "end_point_m"),
    ("mean angle (deg)", measure.degrees, "rotation_mean_rad"),
)
"""Columns of means, their units, and the fields of ``MotionErrors``."""


def group_table(groups: Groups) -> Table:
    """Means of each task and condition."""
    rows: list[dict[str, Cell]] = []
    for name, motions in groups.items():
        of_group = measure.grouped(motions, attrgetter("task", "condition"))
        rows += [
            {
                "task": task,
                "condition": condition.replace("_", " "),
                "against": name,
                "trials": len(members),
                **{
                    column: shown(measure.average(members, attrgetter(field)))
                    for column, shown, field in COLUMNS
                },
            }
            for (task, condition), members in sorted(of_group.items(), key=itemgetter(0))
        ]
    return Table.of(
        rows,
        id="motion",
        title="Recorded, planned and executed motions",
        note="Tool centre point, recorded against that replay, means over trials. Lag: by how much "
        "the recorded one comes later; path: distance after the lag is taken out; at equal times "
        "both count together.",
    )


MEANING = {
    PLANNED: "recorded against the planned replay (what was commanded; the controller's tracking "
    "error and delay)",
    EXECUTED: "recorded against the executed replay (the joints the robot reported; kinematics and "
    "base calibration)",
}
SHARED = "not computed: trials share one calibration"


def motion_results(motions: Sequence[MotionSummary]) -> measure.Part:
    """Measure recorded against replayed motions, mean over trials, and their errors over time."""
    if not motions:
        reason = "no trial has both a recorded tool pose and a dynamic replay's"
        return measure.Part(missing=(f"motion errors: no data ({reason})",))
    groups = {name: [m for m in motions if m.against == name] for name in MEANING}
    found = [m for name, members in groups.items() for m in _measure(name, members)]
    return measure.Part(measurements=tuple(found), tables=(group_table(groups),))


def _measure(name: str, motions: Sequence[MotionSummary]) -> list[Measurement]:
    how = " or ".join(sorted({motion.aligned_by for motion in motions})) or "stamps"
    why = f"no trial knows it of {MEANING[name].split(' (')[0]}"
    measurements = []
    for field, quantity in MOTIONS.items():
        known = [motion for motion in motions if getattr(motion, field) is not None]
        values = list(map(attrgetter(field), known))
        measurements.append(
            measure.measured(
                quantity.of(against=name, meaning=MEANING[name], how=how),
                partial(measure.mean_of, values, "motion error", why),
                n=len(known),
                counted="trial",
                reason_without_interval=SHARED,
                episodes=[motion.episode for motion in known],
            )
        )
    return measurements
