"""How fast and how hard a commanded path moves the arm at its peaks, and with what in the hand.

A controller goes from waypoint to waypoint as the robot file says. Straight lines have corners,
which it rounds by parabolas (Craig, linear segments with parabolic blends), here of at most
``ROUNDED_S`` on either side. A cubic spline begins and ends at rest, a quintic one without
acceleration too. Peaks of their derivatives lie at knots or where the next derivative is zero:
nothing between two samples is missed.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from jaxtyping import Int

from bridge.task.causes import Cause
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from twin.replay.failure import Failure
from twin.replay.path import JointPath
from twin.robot.loads import Load, Loads, Rows, Times
from twin.robot.model import RobotModel, without_dynamics

ROUNDED_S = 0.04
"""A corner is rounded from half the way to it on, and no longer before it: UR's servoj looks 0.03 s
to 0.2 s ahead."""
_CYCLE_S = 1e-4
"""No corner is rounded in less: knots nearer to each other differ by rounding."""
SLACK = 1.02
"""Rounded numbers may exceed a limit by as little as this."""
ACCURACY = {"tool_speed_m_s": 0.05, "elbow_speed_m_s": 0.05, "momentum_kg_m_s": 3.0, "power_W": 10}
"""An arm stops by itself so much before the limits that it is set to: UR's user manual."""

Stamps = Int[np.ndarray, " _"]


def held_of(plan: Plan, task: Task) -> list[Load]:
    """Name the heaviest object that a plan may hold each time it closes the gripper.

    Its stages say which, by the task's tables; without a stage it may be any that the task moves.
    """
    tables = {str(table["id"]): table for table in task.stages}
    found = []
    for closed, group in groupby(plan.tau, key=lambda waypoint: waypoint.g == 1):
        run = list(group)
        if not closed:
            continue
        start, end = run[0].t_ns, run[-1].t_ns
        during = [s for s in plan.stages if s.t_start_ns <= end and s.t_end_ns >= start]
        rows = [tables.get(stage.id, {}) for stage in during]
        names = {row.get(key) for row in rows for key in ("grasp", "carry", "release")}
        objects = [n for n in task.objects if n in (names if during else task.manipulated)]
        masses = {name: task.objects[name].mass_kg for name in objects}
        if masses:
            name = max(masses, key=lambda key: masses[key])
            found.append(Load(name=name, mass_kg=masses[name], start_ns=start, end_ns=end))
    return found


def motion_failures(path: JointPath, robot: RobotModel, held: Sequence[Load] = ()) -> list[Failure]:
    """Find where a commanded path asks for more than the robot has, each cause at its worst."""
    record = robot.record
    limits = (robot.velocity_limit_rad_s, record.acceleration_rad_s2, record.jerk_rad_s3)
    found = [
        failure
        for order, limit in enumerate(limits, start=1)
        if limit is not None and len(path.times_ns) > 1
        for failure in _over(*_derivative(path, order), np.array(limit), robot, order)
    ]
    return found + _too_heavy(robot, held) + list(_stops(path, robot, held))


def _derivative(path: JointPath, order: int) -> tuple[Times, Rows]:
    """Times and sizes of all that may be the peak of the path's derivative."""
    if path.curve is not None:
        wanted = path.curve.derivative(order)
        roots = np.ravel(wanted.derivative().roots(extrapolate=False))
        inner = [np.ravel(item)[np.isfinite(np.ravel(item))] for item in roots]
        times = np.unique(np.concatenate([path.curve.x, *inner]))
        return times, np.abs(wanted(times))
    times, speeds = path.times_ns * 1e-9, _speeds(path)
    if order == 1:
        return times[:-1], np.abs(speeds)
    accelerations = _at_corners(path, speeds)
    if order == 2:
        return times, np.abs(accelerations)
    return times[:-1], np.abs(np.diff(accelerations, axis=0)) / np.diff(times)[:, None]


def _speeds(path: JointPath) -> Rows:
    return np.asarray(np.diff(path.joints_rad, axis=0) / (np.diff(path.times_ns)[:, None] * 1e-9))


def _at_corners(path: JointPath, speeds: Rows) -> Rows:
    """What rounds each corner; a whole path is at rest before its start and after its end."""
    knots = path.times_ns
    spacing = _spacing(knots, knots)
    given = path.waypoints_ns
    if given is not None:  # what lies between them is ours, and bends as it must
        spacing = np.where(np.isin(knots, given), _spacing(knots, given), spacing)
    half = np.clip(spacing * 0.5e-9, _CYCLE_S, ROUNDED_S)
    ends = np.pad(speeds, ((1, 1), (0, 0)), mode="edge" if path.moving else "constant")
    return np.asarray(np.diff(ends, axis=0) / (2 * half[:, None]))


def _spacing(times_ns: Stamps, others_ns: Stamps) -> Stamps:
    """How far the nearest of other times is before or after each time."""
    after = others_ns[np.minimum(np.searchsorted(others_ns, times_ns, "right"), len(others_ns) - 1)]
    before = others_ns[np.maximum(np.searchsorted(others_ns, times_ns, "left") - 1, 0)]
    gaps = np.stack([after - times_ns, times_ns - before])
    return np.asarray(np.where(gaps > 0, gaps, np.iinfo(np.int64).max).min(axis=0))


_WORDS = (
    (Cause.JOINT_SPEED, "moves at", "rad/s"),
    (Cause.JOINT_ACCELERATION, "is accelerated at", "rad/s^2"),
    (Cause.JOINT_JERK, "is jerked at", "rad/s^3"),
    (Cause.JOINT_TORQUE, "needs", "Nm"),
)


def _over(
    times_s: Times, values: Rows, limit: Times, robot: RobotModel, order: int
) -> Iterator[Failure]:
    """Name the joint that is farthest beyond its limit, and what would help."""
    share = np.where(np.isfinite(values), values, np.inf) / limit
    index, joint = np.unravel_index(int(np.argmax(share)), share.shape)
    if share[index, joint] <= SLACK:
        return
    name, (cause, verb, unit) = robot.record.joints[joint], _WORDS[order - 1]
    slower = float(share[index, joint]) ** (1 / order)
    help_ = f"; {slower:.2f} times as long there would do" if order < len(_WORDS) else ""
    detail = (
        f"{name} {verb} {values[index, joint]:.2f} {unit} at {times_s[index]:.2f} s, the limit is "
        f"{limit[joint]:.2f} {unit}{help_}"
    )
    t_ns = max(0, round(float(times_s[index]) * 1e9))
    yield Failure(t_ns=t_ns, cause=cause, bodies=(name,), detail=detail)


def _too_heavy(robot: RobotModel, held: Sequence[Load]) -> list[Failure]:
    most_kg = robot.record.payload_kg
    return [
        Failure(
            t_ns=item.start_ns,
            cause=Cause.PAYLOAD,
            bodies=(item.name,),
            detail=f"{item.name} weighs {item.mass_kg:g} kg, {item.mass_kg - most_kg:.2f} kg more "
            f"than the {most_kg:g} kg of {robot.name}, and is held at {item.start_ns * 1e-9:.2f} s",
        )
        for item in held
        if most_kg is not None and not item.mass_kg <= most_kg
    ][:1]


def payload_unknown(robot: RobotModel, held: Sequence[Load]) -> str | None:
    """Say that nobody knows whether the arm may carry what is held; None where it is known."""
    if not held or robot.record.payload_kg is not None:
        return None
    return f"the robot file of {robot.name} does not say what it may carry; set payload_kg"


def _stops(path: JointPath, robot: RobotModel, held: Sequence[Load]) -> Iterator[Failure]:
    """Find where the motors are too weak, and where the arm's safety settings would stop it."""
    times_s, joints, speeds, accelerations = _samples(path)
    if len(path.times_ns) < 2:
        return
    found = Loads(robot, held).along(times_s, joints, speeds, accelerations)
    torques = found.pop("torques")
    if not any(without_dynamics(robot)):
        effort = robot.model.effortLimit[robot.arm_velocity_ids]
        yield from _over(times_s, np.abs(torques), effort, robot, len(_WORDS))
    fastest = robot.record.acceleration_rad_s2
    if fastest is not None:
        found["stop_time_s"] = (np.abs(speeds) / np.array(fastest)).max(axis=1)
    for name, values in found.items():
        limit = getattr(robot.record, name)
        if limit is None:
            continue
        index = int(np.argmax(np.where(np.isfinite(values), values, np.inf)))
        if values[index] <= limit * SLACK - ACCURACY.get(name, 0.0):
            continue
        cause, words, unit = _SETTINGS[name]
        detail = f"{words} {values[index]:.2f} {unit} at {times_s[index]:.2f} s, the limit is "
        detail += f"{limit:g} {unit}"
        if name in ACCURACY:
            detail += f" and the arm may stop {ACCURACY[name]:g} {unit} before it"
        yield Failure(t_ns=round(float(times_s[index]) * 1e9), cause=cause, detail=detail)


_SETTINGS = {
    "tool_speed_m_s": (Cause.TOOL_SPEED, "the tool moves at", "m/s"),
    "elbow_speed_m_s": (Cause.ELBOW_SPEED, "the elbow moves at", "m/s"),
    "momentum_kg_m_s": (Cause.MOMENTUM, "the arm and what it holds have a momentum of", "kg m/s"),
    "power_W": (Cause.POWER, "the motors give", "W"),
    "stop_time_s": (Cause.STOP_TIME, "the arm needs for a stop", "s"),
}


def _samples(path: JointPath) -> tuple[Times, Rows, Rows, Rows]:
    """Joints, their speeds and accelerations at each knot and at most a step apart [s, rad]."""
    dense_ns = path.dense_times_ns()
    times_ns = np.union1d(path.times_ns, dense_ns[dense_ns > path.times_ns[0]])  # at rest before
    times_s = times_ns * 1e-9
    if path.curve is not None:
        speeds, accelerations = (path.curve(times_s, order) for order in (1, 2))
        return times_s, path.joints_at(times_ns), speeds, accelerations
    joints = path.joints_at(times_ns)
    if len(path.times_ns) < 2:
        return times_s, joints, np.zeros_like(joints), np.zeros_like(joints)
    rises = _speeds(path)
    last = len(rises) - 1
    after = rises[np.clip(np.searchsorted(path.times_ns, times_ns, "right") - 1, 0, last)]
    before = rises[np.clip(np.searchsorted(path.times_ns, times_ns, "left") - 1, 0, last)]
    faster = np.linalg.norm(before, axis=1) > np.linalg.norm(after, axis=1)
    accelerations = np.zeros_like(joints)
    accelerations[np.searchsorted(times_ns, path.times_ns)] = _at_corners(path, rises)
    return times_s, joints, np.where(faster[:, None], before, after), accelerations
