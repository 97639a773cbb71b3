"""Seeded mutations of plans that are fine: one family for each way in which one can be wrong."""

import copy
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from scipy.interpolate import CubicSpline

Record = dict[str, Any]


class Solver(Protocol):
    """The arm, for plans whose joints and poses change together."""

    def joints(self, p_m: Any, q_wxyz: Any, near: Sequence[float]) -> list[float] | None:
        """Joints for a tool pose, near others; None when out of reach."""

    def pose(self, joints_rad: Sequence[float]) -> tuple[list[float], list[float]]:
        """Tool position and quaternion."""


Rng = np.random.Generator
BODIES = ("gripper", "table", "cube", "box", "wrist_3_link", "forearm_link", "scene")


def mutated(base: Record, family: str, rng: Rng, solve: Solver) -> Any:
    """One mutation of a family: a record, or bytes where JSON cannot say it.

    Args:
        base: A plan as sent; it is not altered.
        family: One of ``FAMILIES``.
        rng: Draws what is changed, and by how much.
    """
    plan = copy.deepcopy(base)
    plan["id"] = f"{family}_{int(rng.integers(1 << 40)):x}"
    return FAMILIES[family](plan, rng, solve)


def valid(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Not changed at all."""
    return plan


def shifted_start(plan: Record, rng: Rng, solve: Solver) -> Record:
    """The first waypoints are elsewhere, suddenly or by a way that leads there."""
    tau = plan["tau"]
    offset = rng.normal(0.0, rng.choice([0.03, 0.1, 0.5]), 6)
    if rng.random() < 0.5:
        count = int(rng.integers(1, len(tau)))
        for k in range(count):
            share = 1.0 - k / count
            _turn(tau[k], offset * share)
        _poses_from_joints(plan, solve)
    else:
        for w in tau:
            _turn(w, offset * 0.3)
        _poses_from_joints(plan, solve)
    return plan


def shifted_path(plan: Record, rng: Rng, solve: Solver) -> Record:
    """A stretch of the way is moved, and its joints with it."""
    _move(plan, rng.normal(0.0, 1.0, 3) * rng.choice([0.005, 0.03, 0.1]), rng, solve)
    return plan


def deeper_contact(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Where the tool is low it goes lower, with or without leave to touch the table."""
    if rng.random() < 0.5:
        for stage in plan["stages"]:
            stage["allowed_contacts"].append(["gripper", "table"])
    depth = float(rng.uniform(0.002, 0.06))
    low = min(w["p_m"][2] for w in plan["tau"])
    for w in plan["tau"]:
        share = max(0.0, 1.0 - (w["p_m"][2] - low) / 0.1)
        w["p_m"][2] -= depth * share
    _solve_all(plan, solve)
    return plan


def into_the_box(plan: Record, rng: Rng, solve: Solver) -> Record:
    """It releases lower or beside, where the box's walls are."""
    late = [w for w in plan["tau"] if w["t_ns"] > 0.55 * plan["tau"][-1]["t_ns"]]
    low = min(w["p_m"][2] for w in late)
    shift = np.array([*rng.uniform(-0.1, 0.1, 2), -rng.uniform(0.0, 0.09)])
    for w in late:
        share = max(0.0, 1.0 - (w["p_m"][2] - low) / 0.15)
        w["p_m"] = (np.array(w["p_m"]) + shift * share).tolist()
    _solve_all(plan, solve)
    return plan


def faster(plan: Record, rng: Rng, solve: Solver) -> Record:
    """The whole or a part of it takes less time."""
    factor = float(rng.choice([rng.uniform(1.05, 2.0), rng.uniform(1.5, 30.0)]))
    start = int(rng.integers(0, len(plan["tau"]))) if rng.random() < 0.5 else 0
    times = [w["t_ns"] for w in plan["tau"]]
    for k in range(start + 1, len(times)):
        step = max(1, round((times[k] - times[k - 1]) / factor))
        plan["tau"][k]["t_ns"] = plan["tau"][k - 1]["t_ns"] + step
    later = [float(w["t_ns"]) for w in plan["tau"]]
    times = [float(time) for time in times]  # giant ones are no int64
    for stage in plan["stages"]:
        for key in ("t_start_ns", "t_end_ns"):
            stage[key] = round(float(np.interp(stage[key], times, later)))
    return plan


def other_widths(plan: Record, rng: Rng, solve: Solver) -> Record:
    """The gripper is told something else, or at another time."""
    kind = int(rng.integers(4))
    start = int(rng.integers(0, len(plan["tau"])))
    for w in plan["tau"][start:]:
        if kind == 0:
            w["width_m"] = float(rng.uniform(-0.05, 0.2))
        elif kind == 1:
            w["g"], w["width_m"] = 1, 0.0
        elif kind == 2:
            w["g"], w["width_m"] = 0, 0.085
        else:
            w["width_m"] = float(rng.choice([-1.0, 85.0, 1e6, 0.0]))
    return plan


def other_stages(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Stages change their names, times, order and number."""
    stages, kind = plan["stages"], int(rng.integers(7))
    if kind == 0:
        stages.reverse()
    elif kind == 1:
        del stages[int(rng.integers(len(stages)))]
    elif kind == 2:
        stages[-1]["t_start_ns"] = 0
    elif kind == 3:
        stages[int(rng.integers(len(stages)))]["id"] = str(rng.choice(["x", "", "place", "grasp"]))
    elif kind == 4:
        for stage in stages:
            stage["t_start_ns"] = int(rng.integers(-(10**10), 10**10))
    elif kind == 5:
        stages[0]["allowed_contacts"], stages[-1]["allowed_contacts"] = (
            stages[-1]["allowed_contacts"],
            stages[0]["allowed_contacts"],
        )
    else:
        stages.append(copy.deepcopy(stages[int(rng.integers(len(stages)))]))
    if rng.random() < 0.5:
        return into_the_box(plan, rng, solve)
    return plan


def more_contacts(plan: Record, rng: Rng, solve: Solver) -> Record:
    """More may touch, and often does."""
    for _ in range(int(rng.integers(1, 4))):
        pair = [str(name) for name in rng.choice(BODIES, 2)]
        stage = plan["stages"][int(rng.integers(len(plan["stages"])))]
        stage["allowed_contacts"].append(pair)
    return shifted_path(plan, rng, solve) if rng.random() < 0.5 else plan


def other_task(plan: Record, rng: Rng, solve: Solver) -> Record:
    """It is for something else."""
    plan["task"] = str(rng.choice(["sloth_into_basket", "Cube_into_box", "cube_into_box ", "?"]))
    return plan


def other_robot(plan: Record, rng: Rng, solve: Solver) -> Record:
    """It is for another robot, another frame, or joints in another order."""
    kind = int(rng.integers(4))
    if kind == 0:
        plan["robot"] = str(rng.choice(["ur5", "panda", "", "ur5_parallel_gripper2"]))
    elif kind == 1:
        plan["frame"] = str(rng.choice(["world", "tool0", ""]))
    elif kind == 2:
        plan["joint_names"] = [str(n) for n in rng.permutation(plan["joint_names"])]
    else:
        plan["joint_names"] = [f"panda_joint{k}" for k in range(1, 7)]
    return plan


def not_a_number(plan: Record, rng: Rng, solve: Solver) -> bytes:
    """NaN and infinities, as Python writes them."""
    w = plan["tau"][int(rng.integers(len(plan["tau"])))]
    key = str(rng.choice(["p_m", "q_wxyz", "joints_rad", "width_m"]))
    value = float(rng.choice([math.nan, math.inf, -math.inf]))
    if key == "width_m":
        w[key] = value
    else:
        w[key][int(rng.integers(len(w[key])))] = value
    return json.dumps(plan).encode()


def giant(plan: Record, rng: Rng, solve: Solver) -> Any:
    """Numbers and times beyond anything."""
    kind = int(rng.integers(5))
    w = plan["tau"][int(rng.integers(len(plan["tau"])))]
    if kind == 0:
        w["p_m"][int(rng.integers(3))] = float(rng.choice([1e3, 1e9, 1e300, -1e30]))
    elif kind == 1 and w["joints_rad"] is not None:
        w["joints_rad"][int(rng.integers(6))] = float(rng.choice([7.0, 1e3, 1e300]))
    elif kind == 2:
        plan["tau"][-1]["t_ns"] = 10 ** int(rng.integers(12, 400))
    elif kind == 3:
        w["q_wxyz"] = [float(v) for v in rng.choice([0.0, 1e-300, 1e300], 4)]
    else:
        for stage in plan["stages"]:
            stage["t_start_ns"] = 10 ** int(rng.integers(12, 30))
    return plan


def repeated(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Waypoints, times or ids are there twice."""
    kind, k = int(rng.integers(4)), int(rng.integers(1, len(plan["tau"])))
    if kind == 0:
        plan["tau"].insert(k, copy.deepcopy(plan["tau"][k]))
    elif kind == 1:
        plan["tau"][k]["t_ns"] = plan["tau"][k - 1]["t_ns"]
    elif kind == 2:
        plan["id"] = "always_the_same"
        return shifted_start(plan, rng, solve)
    else:
        first = copy.deepcopy(plan["tau"])
        for w in first:
            w["t_ns"] += plan["tau"][-1]["t_ns"] + int(rng.choice([0, 1, 50_000_000]))
        plan["tau"] += first
    return plan


def swapped_objects(plan: Record, rng: Rng, solve: Solver) -> Record:
    """What is grasped, released and touched is another thing."""
    text = json.dumps(plan["stages"])
    swap = {"cube": "box", "box": "cube"} if rng.random() < 0.5 else {"cube": "table"}
    for old, new in swap.items():
        text = text.replace(f'"{old}"', f'"@{new}"')
    plan["stages"] = json.loads(text.replace("@", ""))
    if rng.random() < 0.7:
        half = 0.5 * plan["tau"][-1]["t_ns"]
        early = [w for w in plan["tau"] if w["t_ns"] < half]
        later = [w for w in plan["tau"] if w["t_ns"] >= half]
        if not early or not later:  # another family has broken the times
            return plan
        low = min(early, key=lambda w: w["p_m"][2])["p_m"]
        late = min(later, key=lambda w: w["p_m"][2])["p_m"]
        shift = np.array(late) - np.array(low)
        shift[2] = -float(rng.uniform(0.0, 0.03))
        for w in early:
            share = max(0.0, 1.0 - (w["p_m"][2] - low[2]) / 0.2)
            w["p_m"] = (np.array(w["p_m"]) + shift * share).tolist()
        _solve_all(plan, solve)
    return plan


def backwards(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Time does not go on: reversed, exchanged, negative."""
    tau, kind = plan["tau"], int(rng.integers(3))
    if kind == 0:
        times = [w["t_ns"] for w in tau]
        for w, t_ns in zip(tau, reversed(times), strict=True):
            w["t_ns"] = t_ns
    elif kind == 1:
        one, other = sorted(rng.choice(len(tau), 2, replace=False).tolist())
        tau[one]["t_ns"], tau[other]["t_ns"] = tau[other]["t_ns"], tau[one]["t_ns"]
    else:
        for w in tau:
            w["t_ns"] -= int(rng.integers(1, 10**10))
    return plan


def joint_jump(plan: Record, rng: Rng, solve: Solver) -> Record:
    """One posture, or all after it, is another one; the poses may agree with it."""
    tau = plan["tau"]
    k, joint = int(rng.integers(len(tau))), int(rng.integers(6))
    size = float(rng.choice([0.2, 1.0, 2 * math.pi, -2 * math.pi, -0.5]))
    for w in tau[k : k + 1 if rng.random() < 0.5 else None]:
        if w["joints_rad"] is not None:
            w["joints_rad"][joint] += size
    if rng.random() < 0.5:
        _poses_from_joints(plan, solve)
    return plan


def jumps_in_time(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Two waypoints lie a nanosecond to a millisecond apart, and far apart otherwise."""
    tau, k = plan["tau"], int(rng.integers(1, len(plan["tau"])))
    tau[k]["t_ns"] = tau[k - 1]["t_ns"] + int(rng.choice([1, 1000, 1_000_000]))
    return plan


def without_joints(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Joints are left out for a stretch, or everywhere, and the way is moved."""
    tau = plan["tau"]
    first = int(rng.integers(len(tau))) if rng.random() < 0.5 else 0
    shift = rng.normal(0.0, 1.0, 3) * rng.choice([0.0, 0.01, 0.1])
    for w in tau[first:]:
        w["joints_rad"] = None
        w["p_m"] = (np.array(w["p_m"]) + shift).tolist()
    return plan


def two_at_once(plan: Record, rng: Rng, solve: Solver) -> Any:
    """Two families, one after the other."""
    names = [n for n in FAMILIES if n in OLD]
    for name in rng.choice(names, 2, replace=False).tolist():
        plan = FAMILIES[name](plan, rng, solve)
    return plan


def slower(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Fine: the same way, stretched in time."""
    factor = float(rng.uniform(1.01, 1.6))
    for item in (*plan["tau"], *plan["stages"]):
        for key in ("t_ns", "t_start_ns", "t_end_ns"):
            if key in item:
                item[key] = round(item[key] * factor)
    return plan


def denser(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Fine: the same way with a waypoint each 10 to 30 ms."""
    plan = _sampled(plan, float(rng.uniform(0.01, 0.03)))
    _poses_from_joints(plan, solve)
    return plan


def _chatter(low_hz: float, high_hz: float) -> Callable[[Record, Rng, Solver], Record]:
    """A joint shakes for a while, softly at first, by 20 to 760 rad/s2."""

    def shaken(plan: Record, rng: Rng, solve: Solver) -> Record:
        hz, joint = float(rng.uniform(low_hz, high_hz)), int(rng.integers(6))
        size = float(np.exp(rng.uniform(math.log(32), math.log(760)))) / (2 * math.pi * hz) ** 2
        plan = _sampled(plan, min(0.02, 1 / hz / float(rng.uniform(5, 12))))
        long_s = max(4 / hz, 0.3)
        start = float(rng.uniform(0.1, max(0.2, plan["tau"][-1]["t_ns"] * 1e-9 - long_s)))
        for w in plan["tau"]:
            share = (w["t_ns"] * 1e-9 - start) / long_s
            if 0 < share < 1:
                wave = math.sin(math.pi * share) ** 2 * math.sin(2 * math.pi * hz * share * long_s)
                w["joints_rad"][joint] += size * wave
        _poses_from_joints(plan, solve)
        return plan

    return shaken


def velocity_step(plan: Record, rng: Rng, solve: Solver) -> Record:
    """A joint goes aside and back at once, from rest to up to 3 rad/s."""
    speed, joint, long_s = float(rng.uniform(1.3, 3.0)), int(rng.integers(6)), 0.06
    plan = _sampled(plan, 0.01)
    start = float(rng.uniform(0.1, 0.9)) * plan["tau"][-1]["t_ns"] * 1e-9
    for w in plan["tau"]:
        t = w["t_ns"] * 1e-9 - start
        if 0 < t < 2 * long_s:
            w["joints_rad"][joint] += speed * min(t, 2 * long_s - t)
    _poses_from_joints(plan, solve)
    return plan


def skims(plan: Record, rng: Rng, solve: Solver) -> Record:
    """On the way to the object the hand sweeps 1 to 4 mm over the table at over 0.5 m/s."""
    plan = _sampled(plan, 0.02)
    low, first = float(rng.uniform(0.001, 0.004)) + 0.01, plan["tau"][0]
    aside = np.array([0.0, float(rng.choice([-1, 1])) * 0.2, 0.0])
    over = np.array(first["p_m"]) + aside
    over[2] = low
    ways = [(np.array(first["p_m"]), over - 1.5 * aside, 1.5), (over - 1.5 * aside, over, 0.75),
            (over, np.array(first["p_m"]), 1.5)]  # fmt: skip
    extra, t = [], 0.0
    for start, end, long_s in ways:
        for k in range(1, round(long_s / 0.02) + 1):
            share = k * 0.02 / long_s
            share = 10 * share**3 - 15 * share**4 + 6 * share**5
            p = (start + share * (end - start)).tolist()
            w = {**copy.deepcopy(first), "t_ns": round((t + k * 0.02) * 1e9), "p_m": p}
            extra.append(w)
        t += long_s
    for item in (*plan["tau"], *plan["stages"]):
        for key in ("t_ns", "t_start_ns", "t_end_ns"):
            if key in item and (item is not plan["stages"][0] or key != "t_start_ns"):
                item[key] += round(t * 1e9)
    plan["tau"] = [copy.deepcopy(first) | {"t_ns": 0}, *extra, *plan["tau"][1:]]
    _solve_all(plan, solve)
    return plan


def _heavy(least_kg: float, most_kg: float) -> Callable[[Record, Rng, Solver], Record]:
    """What it grasps is beyond what the arm may carry: another task's file says so."""

    def loaded(plan: Record, rng: Rng, solve: Solver) -> Record:
        fitting = [kg for kg in HEAVY_KG if least_kg <= kg <= most_kg]
        plan["task"] = f"heavy_{float(rng.choice(fitting)):g}".replace(".", "_")
        return plan

    return loaded


def heavy_without_stages(plan: Record, rng: Rng, solve: Solver) -> Record:
    """And no stage says that anything is grasped."""
    plan["stages"] = []
    return _heavy(5.0, 99.0)(plan, rng, solve)


def says_twice(plan: Record, rng: Rng, solve: Solver) -> bytes:
    """A key is there twice, and readers differ in which they believe."""
    key = str(rng.choice(["tau", "robot", "stages", "frame", "task"]))
    other = json.dumps({"tau": [], "stages": [], "frame": "world"}.get(key, "x"))
    text = json.dumps(plan)
    if rng.random() < 0.5:
        return f'{{"{key}": {other}, {text[1:]}'.encode()
    return f'{text[:-1]}, "{key}": {json.dumps(plan[key])}}}'.encode()


def says_twice_inside(plan: Record, rng: Rng, solve: Solver) -> bytes:
    """A waypoint has two positions, or two times."""
    key, text = str(rng.choice(["p_m", "t_ns", "g"])), json.dumps(plan)
    value = {"p_m": "[0.1, 0.1, 0.1]", "t_ns": "7", "g": "0"}[key]
    return text.replace(f'"{key}":', f'"{key}": {value}, "{key}":', 1).encode()


def waits(plan: Record, rng: Rng, solve: Solver) -> Record:
    """It stands for minutes before it moves, or begins minutes late."""
    by_ns = round(float(rng.uniform(15, 500)) * 1e9)
    for w in plan["tau"][int(rng.integers(2)) :]:
        w["t_ns"] += by_ns
    for stage in plan["stages"]:
        stage["t_start_ns"] += by_ns
        stage["t_end_ns"] += by_ns
    return plan


def since_1970(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Times of a clock, not of the trajectory."""
    for item in (*plan["tau"], *plan["stages"]):
        for key in ("t_ns", "t_start_ns", "t_end_ns"):
            if key in item:
                item[key] += 1_700_000_000_000_000_000
    return plan


def text_for_numbers(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Words, nulls and truths where numbers belong."""
    w = plan["tau"][int(rng.integers(len(plan["tau"])))]
    key = str(rng.choice(["p_m", "q_wxyz", "joints_rad", "t_ns", "g"]))
    value = [str(w[key]), True, None, [], {}, "0.1"][int(rng.integers(6))]
    if isinstance(w[key], list):
        w[key][int(rng.integers(len(w[key])))] = value
    else:
        w[key] = value
    return w and plan


def many_waypoints(plan: Record, rng: Rng, solve: Solver) -> Record:
    """More than anybody can judge in time."""
    one = {key: plan["tau"][0][key] for key in ("p_m", "q_wxyz", "g")}
    count = int(rng.choice([25_000, 60_000, 120_000]))
    plan["tau"] = [{**one, "t_ns": k * 4_000_000} for k in range(count)]
    return plan


def blip(plan: Record, rng: Rng, solve: Solver) -> Record:
    """One waypoint of a dense path is aside by what no limit of angle forbids."""
    plan = _sampled(plan, 0.01)
    w, joint = plan["tau"][int(rng.integers(5, len(plan["tau"]) - 5))], int(rng.integers(6))
    w["joints_rad"][joint] += float(rng.choice([-1, 1]) * rng.uniform(0.005, 0.02))
    _poses_from_joints(plan, solve)
    return plan


def sudden_end(plan: Record, rng: Rng, solve: Solver) -> Record:
    """It ends, or begins, in full motion."""
    tau = plan["tau"]
    rows = np.array([w["joints_rad"] for w in tau])
    speeds = np.abs(np.diff(rows, axis=0)).max(axis=1)
    fast = np.flatnonzero(speeds > 0.8 * speeds.max())
    plan["tau"] = tau[: int(rng.choice(fast)) + 1]
    return plan


def outside_use(plan: Record, rng: Rng, solve: Solver) -> Record:
    """Fine as it is; what comes after its yes is not (``attack_gate.OUTSIDE``)."""
    return plan


HEAVY_KG = (5.5, 6.0, 7.5, 10.0, 20.0, 60.0)
FAMILIES: dict[str, Callable[[Record, Rng, Solver], Any]] = {
    item.__name__: item
    for item in (
        valid,
        shifted_start,
        shifted_path,
        deeper_contact,
        into_the_box,
        faster,
        other_widths,
        other_stages,
        more_contacts,
        other_task,
        other_robot,
        not_a_number,
        giant,
        repeated,
        swapped_objects,
        backwards,
        joint_jump,
        jumps_in_time,
        without_joints,
        two_at_once,
        slower,
        denser,
        velocity_step,
        skims,
        heavy_without_stages,
        says_twice,
        says_twice_inside,
        waits,
        since_1970,
        text_for_numbers,
        many_waypoints,
        blip,
        sudden_end,
    )
} | {
    "chatter_1_to_3_hz": _chatter(1, 3),
    "chatter_3_to_7_hz": _chatter(3, 7),
    "chatter_7_to_15_hz": _chatter(7, 15),
    "chatter_15_to_30_hz": _chatter(15, 30),
    "chatter_30_to_60_hz": _chatter(30, 60),
    "heavy": _heavy(5.0, 8.0),
    "very_heavy": _heavy(8.0, 99.0),
    "yes_too_old": outside_use,
    "yes_of_another_plan": outside_use,
    "yes_and_the_arm_moved": outside_use,
    "yes_and_an_object_moved": outside_use,
    "yes_forged": outside_use,
}
OLD = tuple(FAMILIES)[1:19]
"""Of these two may come together; none is bytes but the one left out."""
OLD = tuple(name for name in OLD if name != "not_a_number")
HONEST = ("valid", "slower", "denser")
OUTSIDE = tuple(name for name in FAMILIES if name.startswith("yes_"))


def _sampled(plan: Record, step_s: float) -> Record:
    """The same joints on a spline, more often."""
    tau = plan["tau"]
    times = np.array([w["t_ns"] for w in tau]) * 1e-9
    curve = CubicSpline(times, [w["joints_rad"] for w in tau], bc_type="clamped")
    places = CubicSpline(times, [w["p_m"] for w in tau], bc_type="clamped")
    dense = []
    for t in np.append(np.arange(0, times[-1] - step_s / 2, step_s), times[-1]):
        w = copy.deepcopy(tau[int(np.searchsorted(times, t, "left"))])
        w["t_ns"], w["joints_rad"], w["p_m"] = round(t * 1e9), curve(t).tolist(), places(t).tolist()
        dense.append(w)
    plan["tau"] = dense
    return plan


def _turn(waypoint: Record, offset: np.ndarray) -> None:
    if waypoint.get("joints_rad") is not None:
        waypoint["joints_rad"] = (np.array(waypoint["joints_rad"]) + offset).tolist()


def _move(plan: Record, shift: np.ndarray, rng: Rng, solve: Solver) -> None:
    """Move a stretch, smoothly in and out of it."""
    tau = plan["tau"]
    middle, wide = int(rng.integers(len(tau))), int(rng.integers(5, len(tau)))
    for k, w in enumerate(tau):
        share = math.exp(-0.5 * ((k - middle) / (wide / 3)) ** 2)
        w["p_m"] = (np.array(w["p_m"]) + shift * share).tolist()
    _solve_all(plan, solve)


def _solve_all(plan: Record, solve: Solver) -> None:
    """Joints for the poses as they are now; where there are none the old ones stay."""
    before: Sequence[float] | None = None
    for w in plan["tau"]:
        if w.get("joints_rad") is None:
            continue
        found = solve.joints(w["p_m"], w["q_wxyz"], before or w["joints_rad"])
        if found is not None:
            w["joints_rad"] = before = found


def _poses_from_joints(plan: Record, solve: Solver) -> None:
    """Poses that agree with the joints."""
    for w in plan["tau"]:
        if w.get("joints_rad") is not None and np.isfinite(w["joints_rad"]).all():
            w["p_m"], w["q_wxyz"] = solve.pose(w["joints_rad"])
