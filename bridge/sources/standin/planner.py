"""The cell's own scripted planner: sees the objects a little wrong and grasps carelessly.

It stands in for a planner that is sometimes wrong, which is what the gate is for. Each call draws
one candidate; its errors depend on the start and the round only, so that both conditions of a
start begin with the same idea.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.clock import ns_from_s
from bridge.geometry import se3
from bridge.sources.standin.cell_file import PlannerNoise
from bridge.sources.standin.kinematics import Kinematics, slerp_poses, tool_down, wrap_rad, yaw_of
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.robot import ARM_JOINTS, BASE_FRAME, MAX_WIDTH_M, ROBOT_NAME
from bridge.task.task_file import Task

PLANNER_NAME = "standin_scripted"
POLICY_NAME = "scripted"
GROUNDING = "stand-in: true poses with seeded noise"
PLANNER_STREAM = 202
WAYPOINT_S = 0.05
HOVER_M = 0.13
"""Height of the tool above the object's centre before the descent."""
CARRY_M = 0.24
"""Height of the tool while carrying."""
RELEASE_CLEARANCE_M = 0.018
"""Between the underside of the held object and the top of the container's walls."""
LOWEST_TOOL_M = 0.016
"""The tips reach 10 mm below the tool frame."""
GRASP_ABOVE_CENTRE_M = 0.004


@dataclass(frozen=True, kw_only=True)
class GraspError:
    """How one candidate misses what was intended."""

    along_m: float
    across_m: float
    yaw_rad: float
    height_m: float
    release_m: tuple[float, float]


NO_ERROR = GraspError(along_m=0.0, across_m=0.0, yaw_rad=0.0, height_m=0.0, release_m=(0.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One movement of the tool, or a wait when it stays where it is."""

    name: str
    stage: str
    T_base_tcp: Float[np.ndarray, "4 4"]
    duration_s: float
    g: int


def draw_error(noise: PlannerNoise, *, start_seed: int, round_: int) -> GraspError:
    """Draw how a candidate is wrong; the same start and round give the same error."""
    rng = np.random.default_rng([PLANNER_STREAM, start_seed, round_])
    release = rng.normal(0.0, noise.release_m, 2)
    return GraspError(
        along_m=float(rng.normal(0.0, noise.grasp_along_m)),
        across_m=float(rng.normal(0.0, noise.grasp_across_m)),
        yaw_rad=float(rng.normal(0.0, noise.grasp_yaw_rad)),
        height_m=float(rng.normal(0.0, noise.grasp_height_m)),
        release_m=(float(release[0]), float(release[1])),
    )


def perceive(
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
    noise: PlannerNoise,
    *,
    start_seed: int,
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Return the objects' poses as this planner sees them: shifted and turned a little."""
    rng = np.random.default_rng([PLANNER_STREAM, start_seed, 10_000])
    seen = {}
    for object_id in sorted(Ts_base_object):
        T = Ts_base_object[object_id].copy()
        turn = rng.normal(0.0, noise.perception_rad)
        q = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        T[:3, :3] = se3.rotation_from_quaternion(q) @ T[:3, :3]
        T[:2, 3] += rng.normal(0.0, noise.perception_m, 2)
        seen[object_id] = T
    return seen


def plan_pick_and_place(
    task: Task,
    seen: Mapping[str, Float[np.ndarray, "4 4"]],
    error: GraspError,
    *,
    kinematics: Kinematics,
    joints_start_rad: Float[np.ndarray, "6"],
    max_joint_speed_rad_s: float,
    plan_id: str,
    condition: str,
    start_id: str,
    parent_id: str | None = None,
    round_: int = 0,
) -> Plan:
    """Plan one attempt: pregrasp, grasp, close, lift, carry, lower, open, retreat, home.

    Raises:
        UnreachablePoseError: When the arm cannot follow.
    """
    object_id, container_id = task.manipulated[0], task.containers[0]
    T_home = kinematics.T_base_tcp(joints_start_rad)
    legs = _legs(task, seen[object_id], seen[container_id], T_home, error)
    tau, bounds = _trajectory(legs, T_home, joints_start_rad, kinematics, max_joint_speed_rad_s)
    return Plan(
        id=plan_id,
        parent_id=parent_id,
        round=round_,
        planner=PLANNER_NAME,
        policy=POLICY_NAME,
        condition=condition,
        start_id=start_id,
        robot=ROBOT_NAME,
        frame=BASE_FRAME,
        task=task.name,
        instruction=task.instruction,
        grounding_source=GROUNDING,
        entities={key: _pose_record(T) for key, T in seen.items()},
        keypoints_m=tuple(_point(seen[key][:3, 3]) for key in (object_id, container_id)),
        joint_names=ARM_JOINTS,
        stages=_stages(task, legs, bounds, seen),
        tau=tau,
    )


def _legs(
    task: Task,
    T_base_object: Float[np.ndarray, "4 4"],
    T_base_container: Float[np.ndarray, "4 4"],
    T_home: Float[np.ndarray, "4 4"],
    error: GraspError,
) -> list[Leg]:
    # A cube looks the same after a quarter turn: take the grasp that turns the wrist least.
    quarter = np.pi / 2
    yaw = yaw_of(T_base_object)
    yaw = min((wrap_rad(yaw + k * quarter) for k in range(4)), key=abs) + error.yaw_rad
    model, container = task.objects[task.manipulated[0]], task.objects[task.containers[0]]
    p = T_base_object[:3, 3] + np.array([0.0, 0.0, GRASP_ABOVE_CENTRE_M + error.height_m])
    R = tool_down(p, yaw)[:3, :3]
    p = p + R[:, 0] * error.along_m + R[:, 1] * error.across_m
    p[2] = max(p[2], LOWEST_TOOL_M)
    above, carried = p.copy(), p.copy()
    above[2] = p[2] + HOVER_M
    carried[2] = CARRY_M
    over = T_base_container[:3, 3] + np.array([*error.release_m, 0.0])
    over[2] = CARRY_M
    low = over.copy()
    below_tool = p[2] - (T_base_object[2, 3] - model.size_m[2] / 2)
    low[2] = T_base_container[2, 3] + container.size_m[2] + below_tool + RELEASE_CLEARANCE_M
    grasp, place = _stage_ids(task)
    return [
        Leg(name="pregrasp", stage=grasp, T_base_tcp=tool_down(above, yaw), duration_s=1.5, g=0),
        Leg(name="grasp", stage=grasp, T_base_tcp=tool_down(p, yaw), duration_s=0.9, g=0),
        Leg(name="settle", stage=grasp, T_base_tcp=tool_down(p, yaw), duration_s=0.2, g=0),
        Leg(name="close", stage=grasp, T_base_tcp=tool_down(p, yaw), duration_s=0.7, g=1),
        Leg(name="lift", stage=grasp, T_base_tcp=tool_down(carried, yaw), duration_s=0.9, g=1),
        Leg(name="carry", stage=place, T_base_tcp=tool_down(over, yaw), duration_s=1.6, g=1),
        Leg(name="lower", stage=place, T_base_tcp=tool_down(low, yaw), duration_s=0.8, g=1),
        Leg(name="settle", stage=place, T_base_tcp=tool_down(low, yaw), duration_s=0.2, g=1),
        Leg(name="open", stage=place, T_base_tcp=tool_down(low, yaw), duration_s=0.5, g=0),
        Leg(name="retreat", stage=place, T_base_tcp=tool_down(over, yaw), duration_s=0.7, g=0),
        Leg(name="home", stage=place, T_base_tcp=T_home, duration_s=1.4, g=0),
    ]


def _stage_ids(task: Task) -> tuple[str, str]:
    """The stages that grasp and release in the task file."""
    grasp = next(stage["id"] for stage in task.stages if stage.get("grasp"))
    place = next(stage["id"] for stage in task.stages if stage.get("release"))
    return grasp, place


def _trajectory(
    legs: Sequence[Leg],
    T_start: Float[np.ndarray, "4 4"],
    joints_start_rad: Float[np.ndarray, "6"],
    kinematics: Kinematics,
    max_joint_speed_rad_s: float,
) -> tuple[tuple[Waypoint, ...], dict[str, tuple[int, int]]]:
    """Sample straight lines at 20 Hz with smooth speed, slower where a joint would race."""
    T_from, joints, t_ns = T_start, joints_start_rad, 0
    tau = [_waypoint(0, T_start, joints_start_rad, legs[0].g)]
    bounds: dict[str, tuple[int, int]] = {}
    for leg in legs:
        count = max(round(leg.duration_s / WAYPOINT_S), 1)
        while True:
            Ts, rows = _sample_leg(T_from, leg.T_base_tcp, joints, count, kinematics)
            steps = np.abs(np.diff(np.vstack([joints, rows]), axis=0))
            speed = float(steps.max()) / WAYPOINT_S
            if speed <= max_joint_speed_rad_s:
                break
            count = int(np.ceil(count * 1.02 * speed / max_joint_speed_rad_s))
        begin_ns = t_ns
        for T, row in zip(Ts, rows, strict=True):
            t_ns += ns_from_s(WAYPOINT_S)
            tau.append(_waypoint(t_ns, T, row, leg.g))
        bounds[leg.stage] = (bounds.get(leg.stage, (begin_ns, 0))[0], t_ns)
        T_from, joints = leg.T_base_tcp, rows[-1]
    return tuple(tau), bounds


def _sample_leg(
    T_from: Float[np.ndarray, "4 4"],
    T_to: Float[np.ndarray, "4 4"],
    joints_rad: Float[np.ndarray, "6"],
    count: int,
    kinematics: Kinematics,
) -> tuple[Float[np.ndarray, "num_poses 4 4"], Float[np.ndarray, "num_poses 6"]]:
    s = np.arange(1, count + 1) / count
    # Minimum-jerk time law (Flash and Hogan 1985): at rest at both ends.
    Ts = slerp_poses(T_from, T_to, s**3 * (10 - 15 * s + 6 * s**2))
    rows = []
    for T in Ts:
        joints_rad = kinematics.joints_for(T, joints_rad)
        rows.append(joints_rad)
    return Ts, np.array(rows)


def _waypoint(
    t_ns: int, T: Float[np.ndarray, "4 4"], joints_rad: Float[np.ndarray, "6"], g: int
) -> Waypoint:
    q, p = se3.split(T)
    w, x, y, z = (float(value) for value in q)
    return Waypoint(
        t_ns=t_ns,
        p_m=_point(p),
        q_wxyz=(w, x, y, z),
        g=g,
        width_m=0.0 if g else MAX_WIDTH_M,
        joints_rad=tuple(float(value) for value in joints_rad),
    )


def _stages(
    task: Task,
    legs: Sequence[Leg],
    bounds: Mapping[str, tuple[int, int]],
    seen: Mapping[str, Float[np.ndarray, "4 4"]],
) -> tuple[Stage, ...]:
    object_id, container_id = task.manipulated[0], task.containers[0]
    lifted, inside = seen[object_id].copy(), seen[object_id].copy()
    close = next(leg for leg in legs if leg.name == "close")
    lift = next(leg for leg in legs if leg.name == "lift")
    lifted[:3, 3] += lift.T_base_tcp[:3, 3] - close.T_base_tcp[:3, 3]
    low = next(leg for leg in legs if leg.name == "open").T_base_tcp
    floor_m = task.objects[container_id].wall_m + task.objects[object_id].size_m[2] / 2
    inside[:2, 3] = low[:2, 3]
    inside[2, 3] = seen[container_id][2, 3] + floor_m
    stages = []
    for index, table in enumerate(task.stages):
        last = index == len(task.stages) - 1
        predicted = inside if table.get("release") else lifted
        start_ns, end_ns = bounds[table["id"]]
        stages.append(
            Stage(
                id=table["id"],
                text=table["text"],
                grasp=table.get("grasp"),
                release=table.get("release"),
                allowed_contacts=tuple((a, b) for a, b in table.get("allowed_contacts", [])),
                terminal=tuple(dict(item) for item in task.success) if last else (),
                predicted_objects={object_id: _pose_record(predicted)},
                t_start_ns=start_ns,
                t_end_ns=end_ns,
            )
        )
    return tuple(stages)


def _point(p: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in p)
    return x, y, z


def _pose_record(T: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    q, p = se3.split(T)
    return {"p_m": [float(v) for v in p], "q_wxyz": [float(v) for v in q]}
