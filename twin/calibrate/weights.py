"""What a run's trials weighed and pushed, by the efforts of the arm's joints.

Effort = inverse dynamics of the arm as described + bias, drift, friction and motor inertia of each
joint + what the description is off (joint zeros, links) + a weight at the tool while something is
held, all a little late. That is linear in what is unknown, so all is fitted at once with normal
priors: free motion tells the arm from the weight, and what it leaves open widens the interval.

Late in an even push the hand feels friction x (weight + what it presses down), a force at the tool
in the place of the weight. That says neither mass nor friction alone; beside a lift it says both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, label
from scipy.stats import chi2

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import JointSample
from bridge.episode.executions import executed_events
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import JOINT_STATES
from bridge.errors import GstError, UsageError
from bridge.task.task_file import ObjectModel, Task
from twin.calibrate.motion import Z_95, stays_alike
from twin.errors import TwinError
from twin.physics.config import PhysicsConfig
from twin.replay.execution import stages_as_executed
from twin.replay.grasps import grasped
from twin.replay.observed import find_grips
from twin.replay.rebuilt_scene import MASSES
from twin.robot.model import RobotModel, load_robot, without_dynamics
from twin.robot.posture import width_track
from twin.scene.store.calibration import write_part

# How efforts are read.
STEP_S = 0.02  # spacing of what is compared
SMOOTH_S = 0.04  # spread of the Gaussian that smooths joints and efforts alike
SLOWEST_S = 0.05  # time between two readings, at most
FEWEST = 20  # samples, at least
NEAR_M = 0.05  # so far from where it closed and opens the hand touches nothing
ABOVE_M = 0.03  # so far above that the object does not touch what it stood on
AROUND_S = 0.5  # so shortly before and after a grasp the arm is not free
LOW_M = 0.005  # so far above the lowest that the tool gets, at most, it pushes
EVEN, EARLY, ENDS = 0.9, 0.4, 3  # of its speed there; of the time, at first; samples at the end
# Standard deviations beforehand.
BIAS_SHARE = 0.05  # of a sensor's bias, in parts of the joint's largest effort
DRIFT_SHARE = 0.02  # of that bias's drift, in the same parts
DRY_SHARE = 0.2  # of dry friction, in the same parts
VISCOUS_SHARE = 0.1  # of friction a rad/s, in the same parts
INERTIA_SHARE = 0.02  # of the motor's inertia a rad/s^2, in the same parts
ZERO_RAD = 0.003  # of joints' zeros
LATE_S = 0.01  # of the delay
LINK_SHARE = 0.05  # of links' masses and inertias, in parts of them
CENTRE_M = 0.01  # of links' centres of mass
MASS_KG = 5.0  # of the weight
HAND_M = 0.05  # of where it lies from the tool, along each axis
LEVER_SHARE = 0.005  # of levers, in parts of them
FORCE_N = 50.0  # of what a push feels along each axis
UNEVEN = 0.03  # of friction along the way, in parts of it
RUBS = (0.32, 0.26)  # friction and its spread: 0.05 to 1, each as likely as its double
# How efforts are fitted and judged.
CREEP_RAD_S = 0.01  # a slower joint may be held by dry friction, either way
LEAST_NM = 1e-3  # no effort is known better
TAILS = 4  # degrees of freedom of Student's t, which residuals have: fingers touch things
ROUNDS = 8  # fits, each with weights from the one before
LEAST_ALIKE, MOST_ALIKE = 0.7, 1.4  # efforts, in parts of those described
KNOWN_SHARE, KNOWN_KG = 0.2, 0.02  # a larger half interval is not determined; parts of the mass
KNOWN_DRAG = 0.5  # the same of a push, in parts of it
NOT_SEEN = "its stiffness is not determined by outlines or fingers; replays use the task file's"
AGREE_SHARE = 0.99  # of trials of one object agree better

Rows = Float[np.ndarray, "_ num_joints"]
Which = Bool[np.ndarray, " _"]
Columns = Float[np.ndarray, "_ num_joints _"]


class NoWeightError(TwinError):
    """Efforts do not say what is held; the message says why."""


def smoothed(times_s: Float[np.ndarray, " _"], joints_rad: Rows, efforts: Rows) -> np.ndarray:
    """Time, joints, speeds, accelerations, efforts and their changes, evenly in time."""
    if not np.isfinite(efforts).all():
        raise NoWeightError("efforts are no numbers")
    if np.ptp(efforts, axis=0).max(initial=0.0) < LEAST_NM:
        raise NoWeightError("efforts do not change: nobody measured them")
    step_s = float(np.median(np.diff(times_s)))
    if not 0 < step_s <= SLOWEST_S:
        raise NoWeightError(f"joints are read every {step_s:.2g} s only")
    even_s = np.arange(times_s[0], times_s[-1], step_s)
    both = [np.interp(even_s, times_s, each) for each in np.hstack([joints_rad, efforts]).T]
    rows = gaussian_filter1d(np.stack(both, axis=1), SMOOTH_S / step_s, axis=0)
    first = np.gradient(rows, step_s, axis=0)
    count = joints_rad.shape[1]
    q, v, tau, changes = rows[:, :count], first[:, :count], rows[:, count:], first[:, count:]
    a = np.gradient(v, step_s, axis=0)
    return np.hstack([even_s[:, None], q, v, a, tau, changes])[:: max(1, round(STEP_S / step_s))]


def weight_of(robot: RobotModel, moved: np.ndarray, free: Which, held: Which) -> dict[str, Any]:
    """Find what is held in some rows of ``smoothed``, given others in which the arm moves freely.

    Returns mass and centre (from the tool, along its axes), each with half of its 95 % interval.
    NoWeightError says why it is not determined.
    """
    if min(free.sum(), held.sum()) < FEWEST:
        raise NoWeightError("too little free motion, or too little with it in the hand")
    used = free | held
    X, weight, y, beforehand, slow = _equations(robot, moved[used], free[used])
    X = np.concatenate([X, held[used, None, None] * weight], axis=2)
    beforehand = np.append(beforehand, MASS_KG * np.array([1.0, *[HAND_M] * 3]))
    x, covariance = _fitted(X, y, beforehand, slow)
    sigma = np.sqrt(np.diag(covariance))
    mass_kg, half_kg = float(x[-4]), Z_95 * float(np.hypot(sigma[-4], LEVER_SHARE * x[-4]))
    if mass_kg <= half_kg:
        raise NoWeightError(f"nothing that weighs is held: {mass_kg:.3f} +- {half_kg:.3f} kg")
    if half_kg > max(KNOWN_SHARE * mass_kg, KNOWN_KG):
        raise NoWeightError(f"known to {half_kg:.2g} kg only: {mass_kg:.3f} kg")
    centre, halves = (x[-3:] / mass_kg).tolist(), (Z_95 * sigma[-3:] / mass_kg).tolist()
    known = {"mass_kg": mass_kg, "half_kg": half_kg}
    return {**known, "centre_m": centre, "centre_half_m": halves}


def drag_of(robot: RobotModel, moved: np.ndarray) -> tuple[dict[str, Any], Which]:
    """Friction x weight [N] of what the fastest push at the lowest level moved, and the rows used.

    With half of its 95 % interval; NoWeightError says why it is not determined.
    """
    joints_rad = moved[:, 1 : 1 + len(robot.joints)]
    p_tool_m = robot.Ts_base_tcp(joints_rad)[:, :3, 3]
    velocity = np.gradient(p_tool_m, moved[:, 0], axis=0) * [1.0, 1.0, 0.0]
    free = p_tool_m[:, 2] > p_tool_m[:, 2].min() + LOW_M
    speeds = np.where(free, 0.0, np.linalg.norm(velocity, axis=1))
    parts, _ = label(speeds > EVEN * speeds.max())
    even = np.flatnonzero(parts == parts[speeds.argmax()])
    pushing = np.isin(np.arange(len(free)), even[round(EARLY * len(even)) : -ENDS])
    if min(free.sum(), pushing.sum()) < FEWEST:
        raise NoWeightError("too little free motion, or too short a push at an even speed")
    used = free | pushing
    X, _, y, beforehand, slow = _equations(robot, moved[used], free[used])
    along = velocity[pushing].mean(axis=0)
    along /= np.linalg.norm(along)
    axes = np.array([np.cross(along, [0.0, 0.0, 1.0]), [0.0, 0.0, -1.0], along])
    push = np.zeros((*y.shape, 6))  # forces along these, then moments: the last as of a weight
    model, data, at = robot.model, robot.model.createData(), robot.arm_velocity_ids
    for row in np.flatnonzero(pushing[used]).tolist():
        frame = (robot.configuration(joints_rad[used][row]), robot.tcp_id, pin.LOCAL_WORLD_ALIGNED)
        J = pin.computeFrameJacobian(model, data, *frame)[:, at]
        push[row] = np.hstack([J[:3].T @ axes.T, J[3:].T])
    beforehand = np.append(beforehand, FORCE_N * np.repeat([1.0, HAND_M], 3))
    x, covariance = _fitted(np.concatenate([X, push], axis=2), y, beforehand, slow)
    pressed_N, felt_N, rubs = max(float(x[-5]), 0.0), float(x[-4]), np.array([-RUBS[0], 1.0])
    noise_N = float(np.hypot((rubs @ covariance[-5:-3, -5:-3] @ rubs) ** 0.5, UNEVEN * felt_N))
    drag_N, half_N = felt_N - RUBS[0] * pressed_N, Z_95 * np.hypot(noise_N, RUBS[1] * pressed_N)
    if half_N > KNOWN_DRAG * drag_N:
        raise NoWeightError(f"no push is felt clearly: {drag_N:.3f} +- {half_N:.3f} N")
    shown = {"drag_N": drag_N, "half_N": float(half_N), "noise_N": noise_N}
    return {**shown, "felt_N": felt_N, "pressed_N": pressed_N}, pushing


def _equations(
    robot: RobotModel, rows: np.ndarray, free: Which
) -> tuple[Columns, Columns, Rows, Float[np.ndarray, " _"], Rows]:
    """What efforts depend on, linearly, in rows of ``smoothed``, in some of which the arm is free.

    Returns the effects of the arm's unknowns and of a weight at the tool, efforts beyond the
    described arm's, spreads beforehand of the arm's unknowns, and how still joints are, 0 to 1.
    """
    for lacking in without_dynamics(robot):
        raise NoWeightError(f"the robot's description gives {lacking}")
    time, (q, v, a, tau, changes) = rows[:, 0], np.split(rows[:, 1:], 5, axis=1)
    model, data, at = robot.model, robot.model.createData(), robot.arm_velocity_ids
    links, tool = [model.getJointId(name) for name in robot.joints], model.frames[robot.tcp_id]
    last, to_link = 10 * (tool.parentJoint - 1), np.zeros((10, 4))
    ball = pin.Inertia(1.0, tool.placement.translation, np.zeros((3, 3)))
    to_link[:, 0], to_link[1:4, 1:] = ball.toDynamicParameters(), tool.placement.rotation
    speed, rise, one = np.zeros(model.nv), np.zeros(model.nv), np.eye(len(at))
    described, columns, weights = np.zeros_like(q), [], []
    dry, share = np.tanh(v / CREEP_RAD_S), (time - time[0]) / np.ptp(time) - 0.5
    for row in range(len(rows)):
        speed[at], rise[at] = v[row], a[row]
        state = (model, data, robot.configuration(q[row]), speed, rise)
        described[row] = pin.rnea(*state)[at]
        zeros = pin.computeRNEADerivatives(*state)[0]
        links_off = pin.computeJointTorqueRegressor(*state)
        own = [links_off[at, 10 * (link - 1) : 10 * link] for link in links]
        joints = (one, share[row] * one, *(np.diag(x[row]) for x in (dry, v, a)))
        weights.append(links_off[at, last : last + 10] @ to_link)
        columns.append(np.hstack([*joints, zeros[np.ix_(at, at)], changes[row][:, None], *own]))
    _refuse_other_efforts(described[free], tau[free])
    most = model.effortLimit[at]
    of_effort = (BIAS_SHARE, DRIFT_SHARE, DRY_SHARE, VISCOUS_SHARE, INERTIA_SHARE)
    spreads = [*(part * most for part in of_effort), np.full(len(at), ZERO_RAD), [LATE_S]]
    for inertia in (model.inertias[link] for link in links):
        parts = inertia.mass, inertia.mass, np.trace(inertia.inertia)
        each = np.multiply((LINK_SHARE, CENTRE_M, LINK_SHARE), parts)
        spreads.append(np.repeat(each, (1, 3, 6)))
    X, weight, beforehand = np.array(columns), np.array(weights), np.concatenate(spreads)
    return X, weight, tau - described, beforehand, 1 - np.abs(dry)


def _refuse_other_efforts(described: Rows, measured: Rows) -> None:
    """An arm's own weight is in its efforts, in Nm and with the sign of its joints."""
    power = (described**2).sum(axis=0)
    each = (measured * described).sum(axis=0) / (power + LEAST_NM)
    turned = np.flatnonzero((each < -LEAST_ALIKE) & (power > 0.05 * power.max())) + 1
    if len(turned):
        raise NoWeightError(f"efforts have the other sign at joint {', '.join(map(str, turned))}")
    times = float(np.average(each, weights=power))
    if not LEAST_ALIKE <= times <= MOST_ALIKE:
        words = "another unit than Nm, or without the arm's own weight"
        raise NoWeightError(f"efforts are {times:.3g} times the described arm's: {words}")


def _fitted(
    X: Columns, y: Rows, beforehand: np.ndarray, slow: Rows
) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns and their covariance; of residuals that are near in time some count as one.

    The last three are levers of the one before, times that one.
    """
    count, joints = X.shape[2], y.shape[1]
    left, alike, x = y, 1.0, np.zeros(count)
    covariance = np.eye(count)
    for _ in range(ROUNDS):
        spread = np.maximum(1.4826 * np.median(np.abs(left), axis=0), LEAST_NM)
        square = spread**2 + (slow * x[2 * joints : 3 * joints]) ** 2
        alike = stays_alike([np.clip(left / np.sqrt(square), -3, 3)]) * (TAILS + 3) / (TAILS + 1)
        fitted = count - float((np.diag(covariance) * beforehand**-2.0).sum()) if x.any() else 0.0
        alike /= max(1 - fitted * alike / y.size, 0.1)
        noise = np.sqrt(alike * (TAILS * square + left**2) / (TAILS + 1))
        rows, values = (X / noise[:, :, None]).reshape(-1, count), (y / noise).ravel()
        covariance = np.linalg.inv(rows.T @ rows + np.diag(beforehand**-2.0))
        x = covariance @ (rows.T @ values)
        left = y - np.einsum("njk,k->nj", X, x)
        beforehand[-3:] = HAND_M * max(x[-4], KNOWN_KG)
    return x, covariance


def calibrate_weights(run: RunFolder) -> tuple[dict[str, Any], str]:
    """Weigh what trials held and pushed; UsageError, with the reasons, where none says anything."""
    found, reasons = dict[str, dict[str, Any]](), dict[str, str]()
    rows, tasks = list[dict[str, Any]](), dict[str, Task]()
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            if episode.info.kind == "trial":
                task = streams.task_file(episode).task()
                tasks[task.name] = task
                rows += weighed(episode, task)
        except GstError as error:
            reasons[path.stem] = str(error)
    if not rows:
        why = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        raise UsageError(f"no trial of {run.path} says what it held or pushed. {why}".rstrip())
    for task, name in sorted({(row["task"], row["object"]) for row in rows}):
        mine = [row for row in rows if (row["task"], row["object"]) == (task, name)]
        lifts, pushes = ([row for row in mine if key in row] for key in ("mass_kg", "drag_N"))
        shown = {"drag": together(pushes, "drag_N")} if pushes else {}
        found.setdefault(task, {})[name] = {**(together(lifts) if lifts else {}), **shown}
    share_masses(tasks, found)
    notes = [note for task, objects in found.items() for note in unlike(tasks[task], objects)]
    record: dict[str, Any] = {"tasks": found, "notes": notes, "not_determined": reasons}
    return write_part(run, MASSES, record)


def weighed(episode: Episode, task: Task) -> list[dict[str, Any]]:
    """What each grasp and push of a trial says; NoWeightError, with the reasons, where none does.

    Seconds count from the episode's first sample.
    """
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise NoWeightError("no robot description was recorded")
    robot, reasons = load_robot(urdf), list[str]()
    shown = list[tuple[str, dict[str, Any], Which]]()
    stamps_ns, joints, efforts = readings(episode, robot.joints)
    begun_ns = streams.first_stamp_ns(episode) or 0
    moved = smoothed((stamps_ns - begun_ns) * 1e-9, joints, efforts)
    times_s, widths = moved[:, 0], width_track(episode, robot.record)
    p_tool_m = robot.Ts_base_tcp(moved[:, 1 : 1 + len(robot.joints)])[:, :3, 3]
    free, grasps = np.ones(len(times_s), dtype=bool), []
    for grip in find_grips(widths.stamps_ns, widths.position[:, 0]):
        closing_s, held_s, opening_s = ((at_ns - begun_ns) * 1e-9 for at_ns in grip)
        held = (times_s >= held_s) & (times_s <= opening_s)
        ends_m = p_tool_m[np.flatnonzero(held)[[0, -1]]] if held.any() else p_tool_m[:1]
        away = np.linalg.norm(p_tool_m[:, None] - ends_m, axis=2).min(axis=1) > NEAR_M
        free &= away & ((times_s < closing_s - AROUND_S) | (times_s > opening_s + AROUND_S))
        grasps.append((grip[1], held & away & (p_tool_m[:, 2] > ends_m[0, 2] + ABOVE_M)))
    for held_ns, held in grasps:
        try:
            name = _object_at(episode, task, held_ns)
            shown.append((name, weight_of(robot, moved, free, held), held))
        except NoWeightError as error:
            reasons.append(str(error))
    pushed = [str(stage["push"]) for stage in task.stages if "push" in stage]
    for name in pushed:
        try:
            if len(pushed) > 1:
                raise NoWeightError(f"{len(pushed)} pushes: nobody said which of them was felt")
            shown.append((name, *drag_of(robot, moved)))
        except NoWeightError as error:
            reasons.append(str(error))
    if not shown:
        raise NoWeightError("; ".join(reasons) or "the fingers close on nothing")
    rows, source = [], {"episode": episode.info.id, "sha256": episode.sha256()}
    for name, numbers, mask in shown:
        from_s, to_s = times_s[mask][[0, -1]].round(2).tolist()
        row = {"task": task.name, "object": name, **numbers, **source}
        rows.append({**row, "from_s": from_s, "to_s": to_s})
    return rows


def readings(episode: Episode, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, joints and efforts of the readings that have them for every joint of an arm."""
    topics = [t for t in episode.topics_of_type(schema.JOINT_STATE) if t.endswith(JOINT_STATES)]
    rows: dict[int, np.ndarray] = {}
    for message in episode.messages(topics):
        sample = JointSample.from_cdr(message.data)
        if set(names) <= set(sample.names) and len(sample.position) == len(sample.effort):
            order = [sample.names.index(name) for name in names]
            rows[sample.stamp_ns] = np.array([sample.position[order], sample.effort[order]])
    if len(rows) < FEWEST:
        raise NoWeightError("no efforts of the arm's joints were recorded")
    stamps_ns = np.array(sorted(rows), dtype=np.int64)
    joints, efforts = np.swapaxes([rows[at] for at in stamps_ns.tolist()], 0, 1)
    return stamps_ns, joints, efforts


def _object_at(episode: Episode, task: Task, at_ns: int) -> str:
    """What is grasped at an instant, by a plan's stages; else the only one that the task moves."""
    events = executed_events(episode)
    for _, plan in streams.plans(episode):
        start_ns, end_ns = streams.execution_ns(events, plan.id)
        if start_ns is not None and start_ns <= at_ns <= (end_ns or at_ns):
            stages = stages_as_executed(plan, events, start_ns)
            name = grasped(replace(plan, stages=stages), at_ns - start_ns)
            if name in task.objects:
                return name
    if len(task.manipulated) != 1:
        raise NoWeightError("nobody said which object was grasped")
    return task.manipulated[0]


def together(rows: Sequence[Mapping[str, Any]], number: str = "mass_kg") -> dict[str, Any]:
    """What trials say of one object: ``value``, its interval, and ``why`` it is not used.

    What the arm's description gets wrong they share: several are no surer than the surest of them.
    """
    values, unit = np.array([row[number] for row in rows]), number.rpartition("_")[2]
    weights = (np.array([row[f"half_{unit}"] for row in rows]) / Z_95) ** -2.0
    value, why = float(np.average(values, weights=weights)), ""
    if float((weights * (values - value) ** 2).sum()) > chi2.ppf(AGREE_SHARE, len(rows) - 1):
        each = ", ".join(f"{row[number]:.3f} {unit} in {row['episode']}" for row in rows)
        why = f"trials do not agree ({each}): another object, or its look-alike"
    sigma = float(weights.max()) ** -0.5
    ends = {"low": value - Z_95 * sigma, "high": value + Z_95 * sigma, "why": why}
    return {"value": value, **ends, "sigma_log": sigma / value, "sources": list(rows)}


def share_masses(tasks: Mapping[str, Task], found: dict[str, dict[str, Any]]) -> None:
    """Say the ``friction`` of what was pushed, where it or its only look-alike was lifted, too.

    The surest push counts: felt = friction x (weight + pressed).
    """
    every = [(t, key, _looks(tasks[t], key)) for t, items in found.items() for key in items]
    held = [(looks, found[t][key]) for t, key, looks in every if "value" in found[t][key]]
    for task, key, looks in every:
        item = found[task][key]
        masses = [item] if "value" in item else [mass for seen, mass in held if seen == looks]
        if "drag" not in item or item["drag"]["why"] or len(masses) != 1 or masses[0]["why"]:
            continue
        row = min(item["drag"]["sources"], key=lambda row: float(row["noise_N"] / row["felt_N"]))
        weight_N = masses[0]["value"] * PhysicsConfig.gravity_m_s2
        share = weight_N / (weight_N + row["pressed_N"])
        sigma = float(np.hypot(row["noise_N"] / row["felt_N"], share * masses[0]["sigma_log"]))
        value = row["felt_N"] / weight_N * share
        low, high = (value * float(np.exp(k * Z_95 * sigma)) for k in (-1, 1))
        friction = {"value": value, "low": low, "high": high, "why": "", "sigma_log": sigma}
        found[task][key] = {**masses[0], **item, "friction": {**friction, "sources": [row]}}


def _looks(task: Task, key: str) -> ObjectModel:
    return replace(task.objects[key], id="", mass_kg=0.0)


def unlike(task: Task, found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Name look-alikes of a task that do not weigh the same, and what nothing shows of toys."""
    notes = [f"{key} of {task.name}: {NOT_SEEN}" for key in found if task.objects[key].soft]
    for (one, a), (other, b) in combinations([x for x in found.items() if "value" in x[1]], 2):
        differ = max(a["low"], b["low"]) > min(a["high"], b["high"])
        if differ and _looks(task, one) == _looks(task, other):
            told = f"{a['value']:.3f} and {b['value']:.3f} kg: mixed up, so are their masses"
            notes.append(f"{one} and {other} of {task.name} look alike and weigh {told}")
    return notes


TOLD = (
    ("drag", "N of friction x weight", "which alone says neither mass nor friction"),
    ("friction", "of friction", "replays use it"),
    ("mass", "kg", "replays and the gate use it"),
)
"""Numbers of an object, their units and uses."""


def describe_weights(record: Mapping[str, Any], calibration_id: str) -> str:
    """Say what trials showed of each object, and from which seconds of which episodes."""
    lines = [f"masses: calibration {calibration_id}", *record["notes"]]
    rows = [(f"  {t} {key}", x) for t, each in record["tasks"].items() for key, x in each.items()]
    for (of, item), (number, unit, use) in product(rows, TOLD):
        found = item if number == "mass" else item.get(number, {})
        if "value" not in found:
            continue
        used = f"not used: {found['why']}" if found["why"] else use
        ends = f"[{found['low']:.4f}, {found['high']:.4f}]"
        lines.append(f"{of}: {found['value']:.4f} {unit} {ends}, {used}")
        for row in found["sources"]:
            told = f"    {row['episode']}, {row['from_s']:.2f} to {row['to_s']:.2f} s"
            if "centre_m" in row:
                pairs = zip(row["centre_m"], row["centre_half_m"], strict=True)
                centre = ", ".join(f"{1e3 * x:.0f} +- {1e3 * half:.0f}" for x, half in pairs)
                told += f": {row['mass_kg']:.4f} +- {row['half_kg']:.4f} kg, its centre "
                told += f"({centre}) mm from the tool"
            lines.append(told)
    reasons = record["not_determined"].items()
    return "\n".join([*lines, *(f"  {name}: not determined: {why}" for name, why in reasons)])
