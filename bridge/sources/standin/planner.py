"""The cell's own scripted planner: sees the objects a little wrong and grasps carelessly.

It stands in for a planner that is sometimes wrong, which is what the gate is for. Each call draws
one candidate; its errors depend on the start and the round only, so that both conditions of a
start begin with the same idea.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, BASE_FRAME, ROBOT_NAME
from bridge.sources.standin.cell_file import PlannerNoise
from bridge.sources.standin.destination import Destination, destination_of, slots_of
from bridge.sources.standin.kinematics import (
    WAYPOINT_S,
    Joints,
    Kinematics,
    Leg,
    Pose,
    TimeLaw,
    Track,
    UnreachablePoseError,
    follow_legs,
    minimum_jerk,
    tool_down,
    wrap_rad,
    yaw_of,
)
from bridge.task.check import TABLE, VERBS
from bridge.task.plan import Plan, Stage
from bridge.task.task_file import ObjectModel, Task


def stage_ids(task: Task, object_id: str) -> tuple[str, str, str]:
    """The stages that grasp, carry and release an object; placing may cover the carrying."""

    def of(verb: str) -> str | None:
        return next((stage["id"] for stage in task.stages if stage.get(verb) == object_id), None)

    pick, carry, place = of("grasp"), of("carry"), of("release")
    if pick is None or place is None:
        message = (
            f"task {task.name} has no stage that grasps {object_id} or none that releases it: "
            "the scripted planner needs both. See docs/tasks.md."
        )
        raise UsageError(message)
    return pick, carry or place, place


def planned_stages(
    task: Task,
    legs_of: Mapping[str, Sequence[Leg]],
    bounds: Mapping[str, tuple[int, int]],
    seen: Mapping[str, Pose],
    places: Mapping[str, Destination | None],
) -> tuple[Stage, ...]:
    """What a plan says of each stage of its task: when it is, and where it leaves its object."""
    stages = []
    for index, table in enumerate(task.stages):
        last = index == len(task.stages) - 1
        object_id = _object_of(task, table)
        model, place = task.objects[object_id], places[object_id]
        predicted = _predicted(model, place, legs_of[object_id], seen[object_id], table)
        start_ns, end_ns = bounds[table["id"]]
        stages.append(
            Stage(
                id=table["id"],
                text=table["text"],
                grasp=table.get("grasp"),
                release=table.get("release"),
                push=table.get("push"),
                allowed_contacts=tuple((a, b) for a, b in table.get("allowed_contacts", [])),
                terminal=tuple(dict(item) for item in task.success) if last else (),
                predicted_objects={object_id: se3.pose_record(predicted)},
                t_start_ns=start_ns,
                t_end_ns=end_ns,
            )
        )
    return tuple(stages)


def _object_of(task: Task, stage: Mapping[str, Any]) -> str:
    """The object a stage handles."""
    for verb in VERBS:
        if stage.get(verb) in task.manipulated:
            return str(stage[verb])
    message = (
        f"stage {stage['id']} of task {task.name} grasps, carries, releases and pushes nothing: "
        "the scripted planner cannot plan it. See docs/tasks.md."
    )
    raise UsageError(message)


def _predicted(
    model: ObjectModel,
    destination: Destination | None,
    legs: Sequence[Leg],
    T_base_object: Pose,
    table: Mapping[str, Any],
) -> Pose:
    """Where a stage leaves its object: lifted, over where it belongs, lying there, or pushed."""
    tool = {leg.name: leg.T_base_tcp for leg in legs}
    place = {name: T_base_tcp[:3, 3] for name, T_base_tcp in tool.items()}
    T = T_base_object.copy()
    if destination is None:
        along = place["push"] - place["down"]
        touch = _reach_m(model, T, along) * along / np.linalg.norm(along)
        T[:2, 3] = (place["push"] + touch)[:2]
    elif table.get("release"):
        T[:2, 3] = place["open"][:2]
        T[2, 3] = destination.resting_m(model)
        if destination.is_turned:
            T[:3, :3] = tool["open"][:3, :3] @ tool["close"][:3, :3].T @ T[:3, :3]
    else:
        T[:3, 3] += place["carry" if table.get("carry") else "lift"] - place["close"]
    return T


PLANNER_NAME = "standin_scripted"
POLICY_NAME = "perturbed"
GROUNDING = "stand-in: true poses with seeded noise"
GROUNDING_GATE = "gst localisation v1 of the gate"
PLANNER_STREAM = 202
HOVER_M = 0.13
"""Height of the tool above the object's centre before the descent."""
CARRY_M = 0.24
"""Height of the tool while carrying."""
LOWEST_TOOL_M = 0.016
"""The tips reach 10 mm below the tool frame."""


@dataclass(frozen=True, kw_only=True)
class GraspError:
    """How one candidate misses what was intended."""

    along_m: float
    across_m: float
    yaw_rad: float
    height_m: float
    release_m: tuple[float, float]


NO_ERROR = GraspError(along_m=0.0, across_m=0.0, yaw_rad=0.0, height_m=0.0, release_m=(0.0, 0.0))


def draw_error(noise: PlannerNoise, *, start_seed: int, round_: int, index: int = 0) -> GraspError:
    """Draw how a candidate is wrong; the same start, round and object give the same error."""
    # The first object's stream has no index: a task with one object draws what it always drew.
    more = [index] if index else []
    rng = np.random.default_rng([PLANNER_STREAM, start_seed, round_, *more])
    release = rng.normal(0.0, noise.release_m, 2)
    return GraspError(
        along_m=float(rng.normal(0.0, noise.grasp_along_m)),
        across_m=float(rng.normal(0.0, noise.grasp_across_m)),
        yaw_rad=float(rng.normal(0.0, noise.grasp_yaw_rad)),
        height_m=float(rng.normal(0.0, noise.grasp_height_m)),
        release_m=(float(release[0]), float(release[1])),
    )


def perceive(
    Ts_base_object: Mapping[str, Pose], noise: PlannerNoise, *, start_seed: int
) -> dict[str, Pose]:
    """Return the objects' poses as this planner sees them: shifted and turned a little.

    The same start is always seen with the same error.
    """
    rng = np.random.default_rng([PLANNER_STREAM, start_seed, 10_000])
    seen = {}
    for object_id in sorted(Ts_base_object):
        T = Ts_base_object[object_id].copy()
        turn = rng.normal(0.0, noise.perception_rad)
        T[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, turn])) @ T[:3, :3]
        T[:2, 3] += rng.normal(0.0, noise.perception_m, 2)
        seen[object_id] = T
    return seen


def plan_pick_and_place(
    task: Task,
    seen: Mapping[str, Pose],
    error: GraspError | Sequence[GraspError],
    *,
    kinematics: Kinematics,
    joints_start_rad: Joints,
    max_joint_speed_rad_s: float,
    plan_id: str,
    condition: str,
    start_id: str,
    round_: int = 0,
    grounding: str = GROUNDING,
) -> Plan:
    """Plan one attempt: each object in turn into its slot or to its mark; then home."""
    count = len(task.manipulated)
    errors = [error] * count if isinstance(error, GraspError) else list(error)
    follow = partial(
        follow_legs, kinematics=kinematics, max_joint_speed_rad_s=max_joint_speed_rad_s
    )
    T_home = kinematics.T_base_tcp(joints_start_rad)
    track = Track.at_rest(T_home, joints_start_rad)
    track, legs_of, places = _each_in_turn(task, seen, errors, track, T_home, follow)
    targets = (place.id for place in places.values() if place is not None and place.id != TABLE)
    keypoints = dict.fromkeys((*task.manipulated, *targets))
    last = legs_of[task.manipulated[-1]][-1].stage
    track = follow(track, [Leg(name="home", stage=last, T_base_tcp=T_home, duration_s=1.4, g=0)])
    return Plan(
        id=plan_id,
        round=round_,
        planner=PLANNER_NAME,
        policy=POLICY_NAME,
        condition=condition,
        start_id=start_id,
        robot=ROBOT_NAME,
        frame=BASE_FRAME,
        task=task.name,
        instruction=task.instruction,
        grounding_source=grounding,
        entities={key: se3.pose_record(T) for key, T in seen.items()},
        keypoints_m=tuple(_point(seen[key][:3, 3]) for key in keypoints),
        joint_names=ARM_JOINTS,
        stages=planned_stages(task, legs_of, track.bounds, seen, places),
        tau=track.tau,
    )


Follow = Callable[[Track, list[Leg]], Track]
"""``follow_legs`` of one arm."""


def _each_in_turn(
    task: Task,
    seen: Mapping[str, Pose],
    errors: Sequence[GraspError],
    track: Track,
    T_home: Pose,
    follow: Follow,
) -> tuple[Track, dict[str, list[Leg]], dict[str, Destination | None]]:
    """Move each object from where it is seen, past what was moved before it."""
    places: dict[str, Destination | None] = {
        key: None if pushing_stage(task, key) else destination_of(task, key, seen)
        for key in task.manipulated
    }
    slots = slots_of({key: place for key, place in places.items() if place is not None})
    legs_of: dict[str, list[Leg]] = {}
    then = dict(seen)
    for index, key in enumerate(task.manipulated):
        if places[key] is None:
            ways = _pushes(task, key, seen[key], errors[index])
        else:
            place = destination_of(task, key, then)  # which may have been moved before
            places[key] = place
            ways = _ways(task, key, seen[key], place, errors[index], slots[key])
        # From object to object the wrist can wind up until each way goes past a joint's limit:
        # then it is first turned where it is, to how it is at home.
        T_turned, stage = T_home.copy(), ways[0][0].stage
        T_turned[:3, 3] = track.T_base_tcp[:3, 3]
        back = Leg(name="turn_back", stage=stage, T_base_tcp=T_turned, duration_s=1.0, g=0)
        unwound = [[back, *legs] for legs in ways]
        track, legs_of[key] = _first_reachable(track, [*ways, *unwound], follow)
        released = {"release": key}
        then[key] = _predicted(task.objects[key], places[key], legs_of[key], seen[key], released)
    return track, legs_of, places


def _first_reachable(
    track: Track, choices: Sequence[list[Leg]], follow: Follow
) -> tuple[Track, list[Leg]]:
    """Take the first way the arm can follow; the last one's error when there is none."""
    for legs in choices[:-1]:
        try:
            return follow(track, legs), legs
        except UnreachablePoseError:
            continue
    return follow(track, choices[-1]), choices[-1]


def _ways(
    task: Task,
    object_id: str,
    T_base_object: Pose,
    destination: Destination,
    error: GraspError,
    slot_m: Float[np.ndarray, "2"],
) -> list[list[Leg]]:
    """The movements for each turn of the wrist that takes the object alike, least turned first."""
    # A cube looks the same after a quarter turn: take the grasp that turns the wrist least.
    turn = task.objects[object_id].grasp_turn_rad
    yaw = yaw_of(T_base_object)
    turns = range(round(2 * np.pi / turn))
    yaws = sorted((wrap_rad(yaw + k * turn) for k in turns), key=abs)
    return [
        _legs(task, object_id, T_base_object, destination, each + error.yaw_rad, error, slot_m)
        for each in yaws
    ]


def _legs(
    task: Task,
    object_id: str,
    T_base_object: Pose,
    destination: Destination,
    yaw: float,
    error: GraspError,
    slot_m: Float[np.ndarray, "2"],
) -> list[Leg]:
    model = task.objects[object_id]
    p = T_base_object[:3, 3] + np.array([0.0, 0.0, model.grasp_m[2] + error.height_m])
    p[:2] += T_base_object[:2, :2] @ np.array(model.grasp_m[:2])
    R = tool_down(p, yaw)[:3, :3]
    p = p + R[:, 0] * error.along_m + R[:, 1] * error.across_m
    p[2] = max(p[2], LOWEST_TOOL_M)
    below_tool = p[2] - (T_base_object[2, 3] - model.size_m[2] / 2)
    carry_m, release_m = _heights_m(task, object_id, destination, below_tool)
    above, carried = p.copy(), p.copy()
    above[2] = p[2] + HOVER_M
    carried[2] = carry_m
    over = destination.T_base[:3, 3] + np.array([*error.release_m, 0.0])
    over[:2] += destination.T_base[:2, :2] @ slot_m
    over[2] = carry_m
    low = over.copy()
    low[2] = release_m
    pick, carry, place = stage_ids(task, object_id)
    there = destination.turned_to(yaw)
    moves = (
        ("pregrasp", pick, above, yaw, 1.5, 0),
        ("grasp", pick, p, yaw, 0.9, 0),
        ("settle", pick, p, yaw, 0.2, 0),
        ("close", pick, p, yaw, 0.7, 1),
        ("lift", pick, carried, yaw, 0.9, 1),
        ("carry", carry, over, there, 1.6, 1),
        ("lower", place, low, there, 0.8, 1),
        ("settle", place, low, there, 0.2, 1),
        ("open", place, low, there, 0.5, 0),
        ("retreat", place, over, there, 0.7, 0),
    )
    return [
        Leg(name=name, stage=stage, T_base_tcp=tool_down(to, turned), duration_s=seconds, g=g)
        for name, stage, to, turned, seconds, g in moves
    ]


def _heights_m(
    task: Task, object_id: str, destination: Destination, below_tool_m: float
) -> tuple[float, float]:
    """Heights of the tool while it carries an object, and when it lets it go.

    A stage that carries may say how close over the destination's top the object passes.
    """
    base_m = destination.top_m + below_tool_m
    near = [s for s in task.stages if s.get("carry") == object_id and "clearance_m" in s]
    if not near:
        return CARRY_M, base_m + destination.clearance_m
    near_m = near[0]["clearance_m"]
    return base_m + near_m, base_m + min(near_m, destination.clearance_m)


FINGERS_HALF_M = 0.010
"""Half the extent of the closed fingers along tool x, the direction in which they push."""
PUSH_TOOL_M = 0.018
"""Height of the tool while it pushes: the tips are 8 mm above the table."""
PUSH_GAP_M = 0.030
"""Between fingers and object when the tool comes down behind it."""
PUSH_SPEED_M_S = 0.10
PUSH_RAMP_S = 0.10
"""From rest to the speed of a push, and back."""
PUSH_STEP_S = 0.02


def pushing_stage(task: Task, object_id: str) -> Mapping[str, Any] | None:
    """The stage that pushes an object; None when it is not pushed."""
    return next((stage for stage in task.stages if stage.get("push") == object_id), None)


def constant_speed(ramp: float) -> TimeLaw:
    """Evenly faster, then even, then evenly slower: at rest at both ends."""
    top = 1 / (1 - ramp)

    def law(s: Float[np.ndarray, " num_times"]) -> Float[np.ndarray, " num_times"]:
        rising, falling = top * s**2 / (2 * ramp), 1 - top * (1 - s) ** 2 / (2 * ramp)
        even = top * (s - ramp / 2)
        return np.select([s < ramp, s > 1 - ramp], [rising, falling], even)

    return law


def _pushes(task: Task, object_id: str, T_base_object: Pose, error: GraspError) -> list[list[Leg]]:
    """Down behind the object with closed fingers, straight on to its mark, back and up.

    For each of the two turns of the wrist whose fingers are as wide in front, least turned first.
    """
    stage, mark = pushing_stage(task, object_id), task.mark_of(object_id)
    if stage is None or mark is None:
        message = f"nothing in task {task.name} says where {object_id} is to be pushed."
        raise UsageError(message)
    to = np.array([*mark, 0.0]) + np.array([*error.release_m, 0.0])
    start = np.array([*T_base_object[:2, 3], 0.0])
    length_m = float(np.linalg.norm(to - start))
    if length_m < PUSH_GAP_M:
        message = f"{object_id} lies {length_m * 1e3:.0f} mm from its mark: too near to be pushed."
        raise UsageError(message)
    along = (to - start) / length_m
    aside = np.array([-along[1], along[0], 0.0]) * error.along_m
    reach = _reach_m(task.objects[object_id], T_base_object, along) * along
    low = np.array([0.0, 0.0, PUSH_TOOL_M])
    behind = start - reach - PUSH_GAP_M * along + aside + low
    ahead = to - reach + aside + low
    back, up = ahead - PUSH_GAP_M * along, np.array([0.0, 0.0, HOVER_M])
    speed = float(stage.get("speed_m_s", PUSH_SPEED_M_S))
    push_s = float(np.linalg.norm(ahead - behind)) / speed + PUSH_RAMP_S
    even, smooth = constant_speed(PUSH_RAMP_S / push_s), minimum_jerk
    moves = (
        ("above", behind + up, 1.5, smooth, WAYPOINT_S),
        ("down", behind, 0.9, smooth, WAYPOINT_S),
        ("push", ahead, push_s, even, PUSH_STEP_S),
        ("wait", ahead, 0.3, smooth, WAYPOINT_S),
        ("back", back, 0.6, smooth, WAYPOINT_S),
        ("up", back + up, 0.8, smooth, WAYPOINT_S),
    )
    yaw = float(np.arctan2(along[1], along[0]))
    return [
        [
            Leg(
                name=name,
                stage=stage["id"],
                T_base_tcp=tool_down(p_m, turned + error.yaw_rad),
                duration_s=seconds,
                g=1,
                law=law,
                step_s=step_s,
            )
            for name, p_m, seconds, law, step_s in moves
        ]
        for turned in sorted((yaw, wrap_rad(yaw + np.pi)), key=abs)
    ]


def _reach_m(model: ObjectModel, T_base_object: Pose, along: Float[np.ndarray, "3"]) -> float:
    """From the middle of the closed fingers to that of the object they touch from behind [m].

    Where a ray from the middle leaves the object's outer box, against the push.
    """
    local = np.abs((T_base_object[:3, :3].T @ along)[:2]) / np.linalg.norm(along)
    half = np.array(model.size_m[:2]) / 2
    return float(np.min(half / np.maximum(local, 1e-9))) + FINGERS_HALF_M


def _point(p: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in p)
    return x, y, z
