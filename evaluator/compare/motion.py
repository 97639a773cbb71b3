"""One motion against another, summed up: recorded against replays, and these against each other.

Three questions. Recorded against the planned replay: what the controller made of the command.
Recorded against the executed replay: how well kinematics and base calibration fit. Executed against
the planned replay: what the twin's own arm made of the difference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
from operator import attrgetter
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bridge.clock import NS_PER_S
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack
from bridge.errors import GstError
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.compare.measure import Part, average, degrees, measured, millimetres, milliseconds
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import (
    NORMALISED_SAMPLES,
    PoseErrors,
    find_lag_s,
    joint_errors,
    pose_errors,
    position_errors,
)
from evaluator.motion_measurements import MOTIONS
from evaluator.result import Cell, Measurement, Table
from evaluator.run_reader.tracks import Tracks, read_tracks

SAME_CLOCK_NS = 2 * NS_PER_S
"""A replay whose stamps start this close to the execution uses the cell's clock."""
PLANNED, EXECUTED, RECORDED = "planned", "executed", "recorded"


@dataclass(frozen=True, kw_only=True)
class MotionSummary:
    """How far one motion of the arm lies from another one."""

    episode: str
    task: str
    condition: str
    plan_id: str
    side: str
    """Whose motion: ``recorded``, or ``executed`` for the replay of the executed joints."""
    against: str
    """Which replay it is compared with: ``planned`` or ``executed``."""
    aligned_by: str
    """``stamps``: one clock; ``starts``: clocks of their own, laid over each other where the
    execution starts; ``normalised``: no start is known, so from first to last sample."""
    num_samples: int
    duration_s: float
    """From the first to the last instant both know."""
    position_mean_m: float
    """At the same instants: what the lag and the path make together."""
    end_point_m: float
    """At the last instant both know."""
    rotation_mean_rad: float
    lag_s: float | None
    """By how much ``side`` comes later, whatever rigid motion lies between; None without times."""
    path_mean_m: float
    """Mean distance after that lag is taken out: another path, not a later one."""
    path_max_m: float
    joint_rms_rad: float | None
    """Over all joints and instants; None without joints of the same names."""


def summarise_motions(
    recorded: Episode, replays: Mapping[str, Episode], *, plan_id: str
) -> tuple[MotionSummary, ...]:
    """Compare a recorded execution with its replays, and these with each other; each read once.

    What has no tool poses in common with another one is left out.
    """
    tracks = {side: read_tracks(episode, plan_id) for side, episode in replays.items()}
    own = read_tracks(recorded, plan_id)
    pairs = [(RECORDED, own, side, tracks[side]) for side in (PLANNED, EXECUTED) if side in tracks]
    if PLANNED in tracks and EXECUTED in tracks:
        pairs.append((EXECUTED, tracks[EXECUTED], PLANNED, tracks[PLANNED]))
    info = recorded.info
    found = []
    for side, tracks_of, against, others in pairs:
        try:
            summary = compare_tracks(tracks_of, others)
        except UndefinedStatisticError:
            continue
        named = replace(summary, side=side, against=against, plan_id=plan_id)
        found.append(replace(named, episode=info.id, task=info.task, condition=info.condition))
    return tuple(found)


def compare_tracks(mine: Tracks, other: Tracks) -> MotionSummary:
    """Compare two motions on one clock, or over normalised time where there is none."""
    aligned_by, mine, other = on_one_clock(mine, other)
    if mine.tool is None or other.tool is None:
        raise _no_tool()
    errors = pose_errors(mine.tool, other.tool)
    summary = _summary(aligned_by, errors)
    if aligned_by != "normalised":
        summary = _without_lag(summary, mine.tool, other.tool, errors)
    return _with_joints(summary, mine.joints, other.joints)


def _no_tool() -> UndefinedStatisticError:
    return UndefinedStatisticError(statistic="motion", reason="no tool poses on both sides")


def on_one_clock(mine: Tracks, other: Tracks) -> tuple[str, Tracks, Tracks]:
    """Return by what two motions are aligned, and both on one clock, the first cut to its plan."""
    mine = mine.cut()
    if mine.tool is None or other.tool is None:
        raise _no_tool()
    if mine.started_ns is None:
        return "normalised", _normalised(mine), _normalised(other.cut())
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


def _normalised(tracks: Tracks) -> Tracks:
    """Give a motion a clock of its own, from 0 at its first sample to 1 s at its last."""
    tool, joints = tracks.tool, tracks.joints
    stamps = np.linspace(0, NS_PER_S, NORMALISED_SAMPLES).round().astype(np.int64)
    if tool is not None:
        tool = replace(tool.normalised_time(NORMALISED_SAMPLES), stamps_ns=stamps)
    if joints is not None:
        asked = np.linspace(joints.stamps_ns[0], joints.stamps_ns[-1], NORMALISED_SAMPLES)
        joints = replace(joints, stamps_ns=stamps, position=joints.at(asked))
    return replace(tracks, tool=tool, joints=joints)


def _summary(aligned_by: str, errors: PoseErrors) -> MotionSummary:
    position, rotation = errors.position_m, errors.rotation_rad
    span_ns = int(errors.stamps_ns[-1] - errors.stamps_ns[0])
    return MotionSummary(
        episode="",
        task="",
        condition="",
        plan_id="",
        side=RECORDED,
        against="",
        aligned_by=aligned_by,
        num_samples=len(position),
        duration_s=span_ns / NS_PER_S,
        position_mean_m=float(position.mean()),
        end_point_m=float(position[-1]),
        rotation_mean_rad=float(rotation.mean()),
        lag_s=None,
        path_mean_m=float(position.mean()),
        path_max_m=float(position.max()),
        joint_rms_rad=None,
    )


def _without_lag(
    summary: MotionSummary, mine: PoseTrajectory, other: PoseTrajectory, errors: PoseErrors
) -> MotionSummary:
    """Align the time first; where no lag can be found the path is that of equal instants."""
    same_m = mine.positions_at(errors.stamps_ns)
    try:
        lag_s = find_lag_s(errors.stamps_ns, same_m, other)
        later = other.shifted(round(lag_s * NS_PER_S))
        path_m = position_errors(errors.stamps_ns, same_m, later)
    except UndefinedStatisticError:
        return summary
    return replace(
        summary, lag_s=lag_s, path_mean_m=float(path_m.mean()), path_max_m=float(path_m.max())
    )


def _with_joints(
    summary: MotionSummary, mine: JointTrack | None, other: JointTrack | None
) -> MotionSummary:
    if mine is None or other is None:
        return summary
    try:
        errors = joint_errors(mine, other)
    except UndefinedStatisticError:
        return summary
    over_time = errors.over_time_rad()
    return replace(
        summary,
        joint_rms_rad=float(np.sqrt((over_time**2).mean())),
    )


Groups = Mapping[str, Sequence[MotionSummary]]
"""By what the motions are held against: planned, executed, or twin."""


def group_table(groups: Groups) -> Table:
    """Means of each task and condition."""
    rows: list[dict[str, Cell]] = []
    for name, motions in groups.items():
        of_group: dict[tuple[str, str], list[MotionSummary]] = {}
        for motion in motions:
            of_group.setdefault((motion.task, motion.condition), []).append(motion)
        for task, condition in sorted(of_group):
            members = of_group[task, condition]
            rows.append(
                {
                    "task": task,
                    "condition": condition.replace("_", " "),
                    "against": name,
                    "trials": len(members),
                    "lag (ms)": milliseconds(average(members, attrgetter("lag_s"))),
                    "path (mm)": millimetres(average(members, attrgetter("path_mean_m"))),
                    "path, largest (mm)": millimetres(average(members, attrgetter("path_max_m"))),
                    "at equal times (mm)": millimetres(
                        average(members, attrgetter("position_mean_m"))
                    ),
                    "end point (mm)": millimetres(average(members, attrgetter("end_point_m"))),
                    "mean angle (deg)": degrees(average(members, attrgetter("rotation_mean_rad"))),
                    "joints, RMS (deg)": degrees(average(members, attrgetter("joint_rms_rad"))),
                }
            )
    return Table.of(
        rows,
        id="motion",
        title="Recorded, planned and executed motions",
        note="Tool centre point, means over trials. Planned, executed: recorded against that "
        "replay. Twin: executed against planned replay. Lag: by how much the first comes later; "
        "path: distance after the lag is taken out; at equal times both count together.",
    )


TWIN = "twin"
MEANING = {
    PLANNED: "recorded against the planned replay (what was commanded; the controller's tracking "
    "error and delay)",
    EXECUTED: "recorded against the executed replay (the joints the robot reported; kinematics and "
    "base calibration)",
    TWIN: "executed against planned replay (what reached the twin's objects differently)",
}
SHARED = "not computed: trials share one calibration"


def motion_results(motions: Sequence[MotionSummary]) -> Part:
    """Measure recorded against replayed motions, mean over trials, and their errors over time."""
    if not motions:
        reason = "no trial has both a recorded tool pose and a dynamic replay's"
        return Part(missing=(f"motion errors: no data ({reason})",))
    groups: dict[str, list[MotionSummary]] = {name: [] for name in MEANING}
    for motion in motions:
        groups[motion.against if motion.side == RECORDED else TWIN].append(motion)
    found = [m for name, members in groups.items() for m in _measure(name, members)]
    return Part(
        measurements=tuple(found),
        tables=(group_table(groups),),
    )


def _measure(name: str, motions: Sequence[MotionSummary]) -> list[Measurement]:
    how = sorted({motion.aligned_by for motion in motions})
    everything = [motion.episode for motion in motions]
    measurements = []
    for field, quantity in MOTIONS.items():
        values = list(map(attrgetter(field), motions))
        there = [value is not None for value in values]
        known = list(compress(values, there))
        measurements.append(
            measured(
                quantity.of(against=name, meaning=MEANING[name], how=" or ".join(how) or "stamps"),
                partial(_mean, known, name),
                n=len(known),
                counted="trial",
                reason_without_interval=SHARED,
                episodes=compress(everything, there),
            )
        )
    return measurements


def _mean(values: Sequence[float], name: str) -> float:
    if not values:
        raise UndefinedStatisticError(
            statistic="motion error", reason=f"no trial knows it of {MEANING[name].split(' (')[0]}"
        )
    return float(np.mean(values))
