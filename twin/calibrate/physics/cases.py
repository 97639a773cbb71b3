"""From recorded episodes to cases: executed joints and gripper commands, poses before and after."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import GRIPPER_STATE, JOINT_STATES, ROBOT_DESCRIPTION
from bridge.errors import GstError, UsageError
from bridge.geometry import se3
from bridge.geometry.signals import runs_of_true
from bridge.robots.robot import Robot, robot_of
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from bridge.terminal import Output
from twin.errors import TwinError
from twin.robot.model import load_robot
from twin.robot.posture import check_clock
from twin.scene.localise.episode import write_localised
from twin.scene.shape.known import yaw_period_rad
from twin.scene.store.folder import scene_hash_of

TIPPED = 0.7
PLANAR = (0, 1, 5)
"""Of a localisation's covariance: x, y and the turn about the vertical."""


class UnusableCaseError(TwinError):
    """An episode from which nothing can be learned about physics."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One executed plan. Times count from its start."""

    episode: str
    """Id and content hash of the episode, for the record."""
    sha256: str
    kind: str
    """Which probe it is, or ``trial``: cases are held out kind by kind."""
    task: Task
    urdf: str
    joint_times_s: Float[np.ndarray, " num_samples"]
    joints_rad: Float[np.ndarray, "num_samples num_joints"]
    width_times_s: Float[np.ndarray, " num_commands"]
    width_commands_m: Float[np.ndarray, " num_commands"]
    """Each holds until the next one."""
    stretches_s: Float[np.ndarray, "num_stretches 2"]
    """From when to when the gripper is near an object or holds one; in between nothing moves."""
    Ts_base_start: dict[str, Float[np.ndarray, "4 4"]]
    """Localised poses of every object before the plan, containers included."""
    objects: tuple[str, ...]
    """Those that move, in the order of the arrays below."""
    start_covariance: Float[np.ndarray, "num_objects 3 3"]
    """Of x, y and turn [m^2, m rad, rad^2]."""
    settled: Float[np.ndarray, "num_objects 3"]
    """Localised x, y and turn afterwards; NaN where an object was not found."""
    settled_covariance: Float[np.ndarray, "num_objects 3 3"]
    turn_period_rad: Float[np.ndarray, " num_objects"]
    """After such a turn an object looks the same."""
    hold_times_s: Float[np.ndarray, " num_holds"]
    """When the fingers stood still on something although they were told to close further."""
    held_widths_m: Float[np.ndarray, " num_holds"]


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What one simulation of a case says about the same observations."""

    settled: Float[np.ndarray, "num_objects 3"]
    held_widths_m: Float[np.ndarray, " num_holds"]


def planar(T_base_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
    """Position on the table and turn about the vertical of a pose.

    For a box that stands on its x axis, the turn is that of its y axis.
    """
    R = T_base_object[:3, :3]
    level = 0 if abs(R[2, 0]) < TIPPED else 1
    return np.array([*T_base_object[:2, 3], np.arctan2(R[1, level], R[0, level])])


HELD_M = 0.002
"""Fingers that stop this far above what they were told hold something."""
HELD_S = 0.15
STILL_M = 3e-4

Series = tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]
"""Times [s] and widths [m]."""


def commands_of(episode: Episode, plan: Plan, start_ns: int) -> Series:
    """What the gripper was told and when [s, m]: from events, else from the plan.

    Args:
        plan: Only events of this plan count; its waypoints stand in where there are none.
        start_ns: Time 0 of the answer, on the recording's clock.
    """
    open_m = streams.recorded_robot(episode).gripper.max_width_m
    times, widths = [0.0], [open_m]
    for event in streams.events(episode):
        if event["type"] == "gripper" and event.get("plan_id") == plan.id:
            told = (event.get("data") or {}).get("width_m")
            shut = 0.0 if event.get("text") == "close" else open_m
            times.append((int(event["stamp_ns"]) - start_ns) * 1e-9)
            widths.append(shut if told is None else float(told))
    if len(times) == 1:
        for waypoint in plan.tau:
            shut = 0.0 if waypoint.g else open_m
            times.append(waypoint.t_ns * 1e-9)
            widths.append(shut if waypoint.width_m is None else waypoint.width_m)
    return np.array(times), np.array(widths)


def widths_of(episode: Episode, start_ns: int) -> Series:
    """Recorded opening [s, m]; empty where it was not recorded.

    Args:
        start_ns: Time 0 of the answer, on the recording's clock.

    Raises:
        UnusableCaseError: When a width is not a number.
    """
    try:
        track = streams.joint_track(episode, GRIPPER_STATE)
    except GstError:
        return np.zeros(0), np.zeros(0)
    if not np.isfinite(track.position).all():
        raise UnusableCaseError("gripper widths hold what is not a number.")
    return (track.stamps_ns - start_ns) * 1e-9, track.position[:, 0].astype(np.float64)


def is_holding(
    times_s: Float[np.ndarray, " num_times"], commands: Series, widths: Series
) -> Bool[np.ndarray, " num_times"]:
    """When the fingers stand still on something; never where no width was recorded.

    Args:
        commands: Widths that the gripper was told; each holds until the next.
        widths: Widths that were recorded; empty: none were.
    """
    if not len(widths[0]):
        return np.zeros(len(times_s), dtype=bool)
    told = commands[1][np.searchsorted(commands[0], times_s, side="right") - 1]
    width = np.interp(times_s, *widths)
    steady = np.abs(width - np.interp(times_s - HELD_S, *widths)) < STILL_M
    return np.asarray(steady & (width > told + HELD_M))


def holds(commands: Series, widths: Series) -> Series:
    """Widths at which the fingers stood still on something, just before they were opened again.

    Args:
        commands: Widths that the gripper was told; each holds until the next.
        widths: Widths that were recorded; empty: none were.
    """
    times_s, width_m = widths
    held_at, held = [], []
    for index in np.flatnonzero(np.diff(commands[1]) > HELD_M) + 1:
        opened_s, told_m = commands[0][index], commands[1][index - 1]
        window = width_m[(times_s > opened_s - HELD_S) & (times_s <= opened_s)]
        if len(window) > 1 and np.ptp(window) < STILL_M and window.mean() > told_m + HELD_M:
            held_at.append(float(opened_s) - HELD_S / 2)
            held.append(float(window.mean()))
    return np.array(held_at), np.array(held)


KINDS = ("probe", "trial")
NEAR_M = 0.085
"""The tool is at work while it is this near to the line from where an object lies before to where
it lies afterwards."""
BEFORE_S, AFTER_S = 0.1, 0.25
GRID_S = 0.02
LONGEST_GAP_S = 0.2
UNKNOWN_SIGMA = (0.003, 0.003, 0.05)
"""x, y [m] and turn [rad] of a pose whose localisation says nothing of its error."""


class NoUsableEpisodesError(UsageError):
    """A run without any such episode."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """One object's localisation."""

    T_base_object: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "3 3"]


def read_cases(run: RunFolder, output: Output) -> tuple[list[Case], dict[str, str]]:
    """Read every probe and trial of a run that was executed and localised.

    Localisations that are missing are made. An episode that cannot be used does not stop the rest.

    Args:
        run: Its episodes are read; localisations that are made are kept in it.
        output: Shows progress, and why an episode is passed over.

    Returns:
        The cases, and per episode why it is none.

    Raises:
        NothingToCalibrateError: No episode can be used; says why.
    """
    paths = run.episodes()
    cases: list[Case] = []
    reasons: dict[str, str] = {}
    with output.progress("localise", len(paths)) as advance:
        for index, path in enumerate(paths):
            try:
                episode = Episode.open(path)
                if episode.info.kind in KINDS:
                    cases.append(read_case(run, episode))
            except GstError as error:
                reasons[path.stem] = str(error)
                output.detail(f"{path.stem}: {error}")
            advance(index + 1, path.stem)
    if not cases:
        raise NoUsableEpisodesError(_nothing(run, paths, reasons))
    return cases, reasons


def _nothing(run: RunFolder, paths: Sequence[Path], reasons: Mapping[str, str]) -> str:
    if not reasons:
        return (
            f"none of the {len(paths)} episodes in {run.episodes_dir} is a probe or a trial. "
            "Record some: robot-gst publish standin --trials 0 --probes 4, or trials of your robot."
        )
    name, reason = next(iter(reasons.items()))
    return f"no probe or trial in {run.episodes_dir} can be used; {name}, for example: {reason}"


def read_case(run: RunFolder, episode: Episode) -> Case:
    """Read one episode.

    Args:
        run: Keeps the localisations; its scene folder says what they were made with.

    Raises:
        UnusableCaseError: Nothing executed, objects not found, soft objects, gaps.
        BackwardTimeError: Its clock went back meanwhile.
    """
    plan, start_ns, end_ns = _executed(episode)
    check_clock(episode, (JOINT_STATES, GRIPPER_STATE), start_ns, end_ns, plan.id)
    task = streams.task_file(episode, plan.task).task()
    if task.soft_objects:
        message = f"task {task.name} has soft objects, and only rigid ones are calibrated."
        raise UnusableCaseError(message)
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise UnusableCaseError(f"no robot description was recorded ({ROBOT_DESCRIPTION}).")
    path = write_localised(run, episode, task, scene_hash=scene_hash_of(run))
    before, after = _localised(path, plan.id)
    objects = _moving(task, before, after)
    arm = streams.joint_track(episode)
    robot = robot_of(urdf)
    _check_joints(arm, start_ns, end_ns, robot)
    times_s = (arm.stamps_ns - start_ns) * 1e-9
    inside = (times_s >= 0.0) & (arm.stamps_ns <= end_ns)
    commands = commands_of(episode, plan, start_ns)
    widths = widths_of(episode, start_ns)
    moving = {key: before[key] for key in objects}
    stretches = _stretches(arm, urdf, (start_ns, end_ns), moving, after, commands, widths)
    hold_times, held = holds(commands, widths)
    kept = np.array([np.any((stretches[:, 0] < t) & (t < stretches[:, 1])) for t in hold_times])
    order = [arm.names.index(name) for name in robot.joints]
    nowhere, unknown = np.full(3, np.nan), np.diag(np.square(UNKNOWN_SIGMA))
    return Case(
        episode=episode.info.id,
        sha256=episode.sha256(),
        kind=plan.stages[0].id if episode.info.kind == "probe" and plan.stages else "trial",
        task=task,
        urdf=urdf,
        joint_times_s=times_s[inside],
        joints_rad=arm.position[inside][:, order].astype(np.float64),
        width_times_s=commands[0],
        width_commands_m=commands[1],
        stretches_s=stretches,
        Ts_base_start={key: item.T_base_object for key, item in before.items()},
        objects=objects,
        start_covariance=np.stack([before[key].covariance for key in objects]),
        settled=np.stack(
            [planar(after[key].T_base_object) if key in after else nowhere for key in objects]
        ),
        settled_covariance=np.stack(
            [after[key].covariance if key in after else unknown for key in objects]
        ),
        turn_period_rad=np.array([yaw_period_rad(task.objects[key]) for key in objects]),
        hold_times_s=hold_times[kept.astype(bool)],
        held_widths_m=held[kept.astype(bool)],
    )


def _moving(task: Task, before: Mapping[str, Found], after: Mapping[str, Found]) -> tuple[str, ...]:
    """The objects that a plan may move, of which one at least was found again."""
    missing = [key for key in task.objects if key not in before]
    if missing:
        message = f"not localised before the plan: {', '.join(missing)}."
        raise UnusableCaseError(message)
    objects = tuple(
        key for key, model in task.objects.items() if not model.fixed and key not in task.containers
    )
    if not any(key in after for key in objects):
        message = f"never localised after the plan: {', '.join(objects)}."
        raise UnusableCaseError(message)
    return objects


def _executed(episode: Episode) -> tuple[Plan, int, int]:
    for _, plan in streams.plans(episode):
        interval = streams.executed_interval_ns(episode, plan.id)
        if interval is not None:
            return plan, *interval
    raise UnusableCaseError("no plan was executed from beginning to end.")


def _localised(path: Path, plan_id: str) -> tuple[dict[str, Found], dict[str, Found]]:
    before: dict[str, Found] = {}
    after: dict[str, Found] = {}
    for record in streams.localisations(Episode.open(path)):
        pose = record.get("T_base_object")
        if not record["found"] or not isinstance(pose, dict):
            continue
        T = se3.pose_from_record(pose)
        found = Found(T_base_object=T, covariance=_covariance(record))
        if record.get("phase") == "start":
            before[str(record["object"])] = found
        elif record.get("plan_id") == plan_id:
            after[str(record["object"])] = found
    return before, after


def _covariance(record: Mapping[str, Any]) -> Float[np.ndarray, "3 3"]:
    numbers = record.get("covariance")
    if numbers is None:
        return np.diag(np.square(UNKNOWN_SIGMA))
    return np.array(numbers, dtype=np.float64).reshape(6, 6)[np.ix_(PLANAR, PLANAR)]


def _check_joints(arm: streams.JointTrack, start_ns: int, end_ns: int, robot: Robot) -> None:
    missing = [name for name in robot.joints if name not in arm.names]
    if missing:
        message = f"joints without a recording: {', '.join(missing)}."
        raise UnusableCaseError(message)
    during = (arm.stamps_ns >= start_ns) & (arm.stamps_ns <= end_ns)
    stamps = arm.stamps_ns[during]
    if len(stamps) < 2 or np.diff(stamps).max() > LONGEST_GAP_S * 1e9:
        raise UnusableCaseError("joint states have gaps while the plan was executed.")
    order = [arm.names.index(name) for name in robot.joints]
    if not np.isfinite(arm.position[during][:, order]).all():
        raise UnusableCaseError(
            "joint states hold what is not a number while the plan was executed."
        )


def _stretches(
    arm: streams.JointTrack,
    urdf: str,
    executed_ns: tuple[int, int],
    before: Mapping[str, Found],
    after: Mapping[str, Found],
    commands: Series,
    widths: Series,
) -> Float[np.ndarray, "num_stretches 2"]:
    """When the tool is near an object's way, or the fingers hold something, from the start [s]."""
    start_ns, end_ns = executed_ns
    times_s = np.arange(0.0, (end_ns - start_ns) * 1e-9, GRID_S)
    stamps = start_ns + np.rint(times_s * 1e9).astype(np.int64)
    robot = load_robot(urdf)
    joints = arm.at(stamps)[:, [arm.names.index(name) for name in robot.joints]]
    tool = robot.Ts_base_tcp(joints)[:, :3, 3]
    busy = np.zeros(len(times_s), dtype=bool)
    for key, item in before.items():
        start = item.T_base_object[:3, 3]
        end = after[key].T_base_object[:3, 3] if key in after else start
        busy |= _distance_m(tool, start, end) < NEAR_M
    if not busy.any():
        raise UnusableCaseError("the tool never came near to an object.")
    busy |= is_holding(times_s, commands, widths)
    merged: list[list[float]] = []
    for first, last in runs_of_true(busy):
        begin_s = max(float(times_s[first]) - BEFORE_S, 0.0)
        end_s = min(float(times_s[last - 1]) + AFTER_S, float(times_s[-1]))
        if merged and begin_s <= merged[-1][1]:
            merged[-1][1] = end_s
        else:
            merged.append([begin_s, end_s])
    return np.array(merged)


def _distance_m(
    points_m: Float[np.ndarray, "num_points 3"],
    start_m: Float[np.ndarray, "3"],
    end_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " num_points"]:
    """From points to the straight line between two others."""
    along = end_m - start_m
    share = np.clip((points_m - start_m) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points_m - start_m - share[:, None] * along, axis=1))
