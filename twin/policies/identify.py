"""Identify how a cell's controller follows what it is sent, from the trials of a run.

What was sent are a policy's targets, else plans that were executed; what it did are the joints,
their efforts and the fingers.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import groupby, islice, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import streams
from bridge.episode.catalogue import find_episodes
from bridge.episode.catalogue_query import CatalogueQuery
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import JointTrack
from bridge.episode.topics import POLICY_TARGETS
from bridge.errors import GstError
from bridge.task.plan import Plan
from twin.calibrate.weights import readings
from twin.policies.response import AT_ONCE, Response, carrying_Nm, largest_Nm
from twin.replay.execution import in_order, stages_as_executed
from twin.replay.path import path_of_plan
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import width_in, width_track

TRIALS = 12
"""So many trials teach it, the nearest in time."""
DELAYS_S = np.arange(0.0, 0.3, 0.004).tolist()
MOVES_RAD_S = 0.05
"""Slower joints say nothing of a lag, and faster ones nothing of a spring."""
PRESSED, FEWEST = 0.1, 20
"""Of so many instants at which something presses a joint with this share of its largest effort, its
stiffness is known."""
GRIPS_M, GOING = 0.01, (0.2, 0.8)
"""Fingers that close by so much say how they do it, on this share of their way."""
FREE = 0.2
"""Those whose speed is within so much of the upper quartile's: slower ones are held up."""

Rows = Float[np.ndarray, "num_times num_joints"]


class Sent(NamedTuple):
    """What one trial's controller was sent, and what it did."""

    targets: JointTrack
    joints: JointTrack
    closed_ns: Sequence[tuple[int, int]]
    """From when to when the fingers were told to be narrower than before."""
    widths: JointTrack
    loads_Nm: Rows
    """What presses the joints, at the times of ``joints``; no rows where nobody measured it."""


def response_of(run: RunFolder, episode: Episode, robot: RobotModel) -> Response:
    """The response that the trials of a run show that are nearest in time.

    Those with a policy's targets, else those with plans. Without either it is at once.

    Args:
        episode: It teaches nothing, where there are others.
    """
    paths = sorted(_starts_ns(run.path).items(), key=lambda item: abs(item[1] - episode.start_ns))
    others = [path for path, _ in paths if path != episode.path.resolve()] or [episode.path]
    for read in (_of_targets, _of_plans):
        sent = (_read(read, path) for path in others)
        found = list(islice((each for each in sent if each is not None), TRIALS))
        if found:
            delay_s, lags_s = lags_of(found)
            grip_delay_s, grip_speed_m_s = grip_of(found)
            return Response(
                delay_s=delay_s,
                lags_s=lags_s,
                stiffness_Nm_rad=stiffness_of(found, delay_s, lags_s, robot),
                grip_delay_s=grip_delay_s,
                grip_speed_m_s=grip_speed_m_s,
            )
    return AT_ONCE


@cache
def _starts_ns(run_path: Path) -> dict[Path, int]:
    run = RunFolder.open(run_path)
    trials = find_episodes(run, CatalogueQuery(kind=("trial",)))
    paths = (run.episodes_dir.resolve() / each.file for each in trials if not each.error)
    return {path: Episode.open(path).start_ns for path in paths}


@cache
def _read(read: Callable[[Episode, RobotModel], Sent | None], path: Path) -> Sent | None:
    with suppress(GstError):
        episode = Episode.open(path)
        urdf = streams.robot_description(episode)
        return None if urdf is None else read(episode, load_robot(urdf))
    return None


def lags_of(trials: Sequence[Sent]) -> tuple[float, tuple[float, ...]]:
    """Delay and the lags of the joints [s]: target(t - delay) - joint(t) = lag * speed(t).

    The least sum of what is left, whatever its sign, so that stretches in which something stops
    the arm count little.
    """
    joints, speeds = _together(trials)
    best, found = math.inf, (0.0, np.zeros(joints.shape[1]))
    for delay_s in DELAYS_S:
        off_rad = _sent_rad(trials, delay_s) - joints
        lags = np.array([_lag_s(off, v) for off, v in zip(off_rad.T, speeds.T, strict=True)])
        left = float(np.abs(off_rad - np.nan_to_num(lags) * speeds).sum())
        if left < best:
            best, found = left, (delay_s, lags)
    delay_s, lags = found
    known = lags[np.isfinite(lags)]
    filled = np.where(np.isfinite(lags), lags, np.median(known) if len(known) else 0.0)
    return delay_s, tuple(filled.round(4).tolist())


def _together(trials: Sequence[Sent]) -> tuple[Rows, Rows]:
    """Joints of all trials, and their speeds."""
    joints = [trial.joints.position for trial in trials]
    speeds = [np.gradient(t.joints.position, t.joints.stamps_ns * 1e-9, axis=0) for t in trials]
    return np.concatenate(joints), np.concatenate(speeds)


def _sent_rad(trials: Sequence[Sent], delay_s: float) -> Rows:
    late_ns = round(delay_s * 1e9)
    return np.concatenate([t.targets.at(t.joints.stamps_ns - late_ns) for t in trials])


def _lag_s(off_rad: Float[np.ndarray, " num"], speed_rad_s: Float[np.ndarray, " num"]) -> float:
    """The lag of a joint; not a number where it does not move."""
    moves = np.abs(speed_rad_s) > MOVES_RAD_S
    if moves.sum() < FEWEST:
        return math.nan
    return max(0.0, _slope(speed_rad_s[moves], off_rad[moves]))


def _slope(x: Float[np.ndarray, " num"], y: Float[np.ndarray, " num"]) -> float:
    """Of y = slope * x with the least sum of absolute errors: a weighted median."""
    slopes, weights = y / x, np.abs(x)
    order = np.argsort(slopes)
    sums = np.cumsum(weights[order])
    return float(slopes[order][np.searchsorted(sums, sums[-1] / 2)])


def stiffness_of(
    trials: Sequence[Sent], delay_s: float, lags_s: Sequence[float], robot: RobotModel
) -> tuple[float, ...]:
    """Stiffness of the joints [Nm/rad]: target(t - delay) - joint = lag * speed + load / stiffness.

    Infinite where hardly anything pressed a joint that moved slowly.
    """
    told = [trial for trial in trials if len(trial.loads_Nm)]
    if not told:
        return ()
    joints, speeds = _together(told)
    off_rad = _sent_rad(told, delay_s) - joints - np.array(lags_s) * speeds
    loads_Nm = np.concatenate([trial.loads_Nm for trial in told])
    least_Nm = PRESSED * largest_Nm(robot)
    pressed = (np.abs(loads_Nm) > least_Nm) & (np.abs(speeds) < MOVES_RAD_S)
    found = []
    for load, off, which in zip(loads_Nm.T, off_rad.T, pressed.T, strict=True):
        gives = _slope(load[which], off[which]) if which.sum() >= FEWEST else 0.0
        found.append(float(f"{1.0 / gives:.3g}") if gives > 0 else math.inf)
    return tuple(found)


def grip_of(trials: Sequence[Sent]) -> tuple[float, float]:
    """Delay [s] and speed [m/s] of fingers that close and that nothing slows down."""
    lines = np.array([line for trial in trials for line in _closings(trial)])
    if not len(lines):
        return 0.0, math.inf
    delays_s, speeds_m_s = lines.T
    free = np.abs(speeds_m_s / np.quantile(speeds_m_s, 0.75, method="higher") - 1.0) < FREE
    delay_s, speed_m_s = np.median(delays_s[free]), np.median(speeds_m_s[free])
    return max(0.0, round(float(delay_s), 4)), round(float(speed_m_s), 4)


def _closings(trial: Sent) -> Iterator[tuple[float, float]]:
    """Delay and speed of each, from the line along which the fingers go."""
    times_ns, widths_m = trial.widths.stamps_ns, trial.widths.position[:, 0]
    for first_ns, last_ns in trial.closed_ns:
        inside = (times_ns >= first_ns) & (times_ns <= last_ns)
        if not inside.any():
            continue
        way_m = widths_m[inside][0] - widths_m[inside]
        low, high = (share * way_m.max() for share in GOING)
        going = (way_m > low) & (way_m < high) & (np.arange(len(way_m)) < way_m.argmax())
        if way_m.max() >= GRIPS_M and going.sum() >= 3:
            times_s = (times_ns[inside][going] - first_ns) * 1e-9
            speed_m_s, at_first_m = np.polyfit(times_s, way_m[going], 1)
            yield -at_first_m / speed_m_s, speed_m_s


def _of_targets(episode: Episode, robot: RobotModel) -> Sent | None:
    """Targets of a policy, each a line of one period from the one before; one alone says little."""
    sent = streams.joint_track(episode, POLICY_TARGETS)
    if len(sent.stamps_ns) < 2:
        return None
    joints = in_order(streams.joint_track(episode), robot.record, episode.info.id)
    targets = in_order(sent, robot.record, episode.info.id)
    first_ns, period_ns = sent.stamps_ns[:1], round(float(np.median(np.diff(sent.stamps_ns))))
    targets = JointTrack(
        names=targets.names,
        stamps_ns=np.concatenate([first_ns, sent.stamps_ns + period_ns]),
        position=np.concatenate([joints.at(first_ns), targets.position]),
    )
    widths_m = width_in(sent.names, sent.position, robot.record)
    told = [] if widths_m is None else _closed_ns(sent.stamps_ns.tolist(), widths_m.tolist())
    return _sent(episode, robot, targets, told)


def _of_plans(episode: Episode, robot: RobotModel) -> Sent | None:
    """The first plan that was executed."""
    events = streams.events(episode)
    for _, plan in streams.plans(episode):
        start_ns, end_ns = streams.execution_ns(events, plan.id)
        if start_ns is None or end_ns is None:
            continue
        path, _, _ = path_of_plan(plan, robot)
        times_ns = path.dense_times_ns(100)
        targets = JointTrack(
            names=robot.joints,
            stamps_ns=start_ns + _as_executed_ns(times_ns, plan, events, start_ns),
            position=path.joints_at(times_ns),
        )
        told = [e for e in events if e["type"] == "gripper"]
        most_m = robot.record.gripper.max_width_m
        widths_m = [most_m, *(_width_m(event, most_m) for event in told)]
        stamps_ns = [start_ns, *(int(event["stamp_ns"]) for event in told), end_ns]
        closed = _closed_ns(stamps_ns, [*widths_m, widths_m[-1]])
        return _sent(episode, robot, targets, closed)
    return None


def _width_m(event: Mapping[str, Any], most_m: float) -> float:
    """What an event tells the fingers."""
    width_m = (event.get("data") or {}).get("width_m")
    return (0.0 if event.get("text") == "close" else most_m) if width_m is None else float(width_m)


def _closed_ns(stamps_ns: Sequence[int], widths_m: Sequence[float]) -> list[tuple[int, int]]:
    """From when the width that is told begins to fall, to when it rises again, or all ends."""
    changes = zip(stamps_ns[1:], pairwise(widths_m), strict=True)
    turns = [(stamp_ns, after < before) for stamp_ns, (before, after) in changes if after != before]
    turns.append((stamps_ns[-1], False))
    firsts = [next(group) for _, group in groupby(turns, key=itemgetter(1))]
    return [(first_ns, end_ns) for (first_ns, falls), (end_ns, _) in pairwise(firsts) if falls]


def _as_executed_ns(
    times_ns: Int[np.ndarray, " num_times"],
    plan: Plan,
    events: Sequence[Mapping[str, Any]],
    start_ns: int,
) -> Int[np.ndarray, " num_times"]:
    """Times of a plan when they were: its stages began when events say."""
    executed = stages_as_executed(plan, events, start_ns)
    planned_ns = [t for stage in plan.stages for t in (stage.t_start_ns, stage.t_end_ns)]
    real_ns = [t for stage in executed for t in (stage.t_start_ns, stage.t_end_ns)]
    found: Int[np.ndarray, " num_times"] = np.interp(times_ns, planned_ns, real_ns).astype(np.int64)
    return found


def _sent(
    episode: Episode, robot: RobotModel, targets: JointTrack, closed: Sequence[tuple[int, int]]
) -> Sent:
    """With what the arm and the fingers did while the targets lasted."""
    joints = in_order(streams.joint_track(episode), robot.record, episode.info.id)
    stamps_ns, first = np.unique(joints.stamps_ns, return_index=True)
    inside = (stamps_ns >= targets.stamps_ns[0]) & (stamps_ns <= targets.stamps_ns[-1])
    seen = JointTrack(
        names=robot.joints, stamps_ns=stamps_ns[inside], position=joints.position[first][inside]
    )
    loads_Nm = np.zeros((0, len(robot.joints)))
    with suppress(GstError):
        times_ns, _, efforts_Nm = readings(episode, robot.joints)
        own_Nm = [carrying_Nm(robot, joints_rad) for joints_rad in seen.position]
        efforts = JointTrack(names=robot.joints, stamps_ns=times_ns, position=efforts_Nm)
        loads_Nm = efforts.at(seen.stamps_ns) - np.array(own_Nm)
    return Sent(targets, seen, closed, width_track(episode, robot.record), loads_Nm)
