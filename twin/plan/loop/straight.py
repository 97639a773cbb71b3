"""The policy ``geometric``: the task's own grasp, straight lines, tool down; nothing is optimised.

It looks at no distance and knows no surface, so it is what better planners are compared with, and
what a cell can be tried with before there is one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.plan import Plan, Waypoint
from bridge.task.task_file import ObjectModel, Task
from twin.plan.loop.propose import Candidate, NoPlanError, refuse_lost
from twin.plan.loop.steer import Steer
from twin.plan.loop.tau import named_keypoints, plan_stage, refuse_without_stages, stages_of
from twin.plan.problem import Problem
from twin.robot.config import IkConfig
from twin.robot.inverse import solve_ik

POLICY = "geometric"
PLANNER = "gst_geometric"
STEP_S = 0.04
HOVER_M = 0.13
CARRY_M = 0.24
HIGHER_M = 0.30
"""Of the tool while it carries: usually, and where a path was refused."""
LOWEST_TOOL_M = 0.016
"""The tips reach 10 mm below the tool."""
OVER_RIM_M = 0.018
OVER_TOP_M = 0.003
"""Between the underside of the object and what it is put into, or onto, when it is let go."""
SPEED_M_S, TURN_RAD_S = 0.25, 1.0
SHORTEST_S = 0.5
PUSH_GAP_M, PUSH_OVER_M, FINGERS_HALF_M = 0.03, 0.004, 0.011
"""Before the fingers meet what they push; of the tool over its lowest place; of the closed pads."""
PUSH_SPEED_M_S, RAMP_S, PUSH_STEP_S = 0.1, 0.12, 0.02
"""Of a push whose task says no speed; time to reach it and to stop; between its waypoints."""
ASIDE_M = (0.0, 0.012, -0.012)
"""Along the pads, where a grasp may be elsewhere than the task says."""
_OTHER_POLICY = "Take another policy, such as nominal."
RELEASES_M = ((0.0, 0.0), (0.015, 0.0), (-0.015, 0.0), (0.0, 0.015), (0.0, -0.015))


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """What one candidate does to every object."""

    turns: int
    aside_m: float
    release_m: tuple[float, float]
    carry_m: float = CARRY_M
    shift_m: tuple[float, float] = (0.0, 0.0)
    """Of the grasp, in the object's frame."""

    @property
    def cost(self) -> float:
        """How far it is from what the task says."""
        return 0.1 * self.turns + abs(self.aside_m) + float(np.linalg.norm(self.release_m))


@dataclass(frozen=True, kw_only=True)
class _Leg:
    stage: str
    T_base_tcp: Float[np.ndarray, "4 4"]
    g: int
    pause_s: float = 0.0
    """Stands here this long instead of moving."""
    even_m_s: float | None = None
    """Goes at this speed but for short ramps; None: slowly, at rest at both ends."""


class GeometricProposer:
    """Offers the task's own grasp first, then turns and shifts of it; draws nothing."""

    def propose(
        self, problem: Problem, *, plan_id: str, seed: int, count: int, steer: Steer | None
    ) -> list[Candidate]:
        """Offer plans, the least turned and shifted first; see ``Proposer``."""
        found: list[Candidate] = []
        why = "no candidate is left that was not refused"
        for choice in _choices(problem.scene.task, steer):
            if len(found) == count:
                break
            if steer is not None and _was_refused(problem, choice, steer):
                continue
            try:
                plan = _plan(problem, choice, plan_id)
            except NoPlanError as error:
                why = str(error)
                continue
            found.append(Candidate(plan=plan, rank=len(found), cost=choice.cost))
        if not found:
            raise NoPlanError(why)
        return found


def _choices(task: Task, steer: Steer | None) -> Iterator[_Choice]:
    turns = max(
        (round(2 * np.pi / task.objects[key].grasp_turn_rad) for key in task.manipulated), default=1
    )
    carry_m = HIGHER_M if steer is not None and steer.change == "path" else CARRY_M
    shift = (0.0, 0.0)
    if steer is not None and steer.toward_m is not None:
        shift = (steer.toward_m[0], steer.toward_m[1])
    everything = [
        _Choice(turns=turn, aside_m=aside, release_m=release, carry_m=carry_m, shift_m=shift)
        for turn, aside, release in product(range(turns), ASIDE_M, RELEASES_M)
    ]
    yield from sorted(everything, key=lambda choice: choice.cost)


def _was_refused(problem: Problem, choice: _Choice, steer: Steer) -> bool:
    """Whether a candidate does again what the refusal asks to change."""
    scene = problem.scene
    mine = scene.task.manipulated if steer.object_id is None else (steer.object_id,)
    for key in mine:
        if "push" in stages_of(scene.task, key):
            continue
        T = scene.Ts_base_object[key]
        tool = _grasp(scene.task.objects[key], T, choice)
        again = steer.has_grasp_like(key, se3.invert(T) @ tool)
        if steer.change in ("grasp", "branch") and again:
            return True
        if steer.change == "release":
            _, released = _release(problem, key, T, tool, choice, scene.Ts_base_object)
            if steer.has_release_like(key, released):
                return True
    return False


def _plan(problem: Problem, choice: _Choice, plan_id: str) -> Plan:
    scene, robot = problem.scene, problem.robot
    task, record = scene.task, robot.record
    refuse_lost(scene)
    refuse_without_stages(task)
    start_rad = robot.home_rad if scene.start_rad is None else scene.start_rad
    T_home = robot.T_base_tcp(start_rad)
    there = dict(scene.Ts_base_object)
    legs: list[_Leg] = []
    for key in task.manipulated:
        pushed = "push" in stages_of(task, key)
        legs += (_push_legs if pushed else _legs)(problem, key, choice, there)
    legs.append(_Leg(stage=legs[-1].stage, T_base_tcp=T_home, g=0))
    tau, bounds = _followed(problem, legs, start_rad)
    return Plan(
        id=plan_id,
        planner=PLANNER,
        policy=POLICY,
        condition="without_replanning",
        robot=record.name,
        frame=record.base_frame,
        task=task.name,
        instruction=task.instruction,
        entities={key: se3.pose_record(T) for key, T in scene.Ts_base_object.items()},
        keypoints_m=named_keypoints(problem),
        joint_names=record.joints,
        stages=tuple(plan_stage(task, table, bounds, there) for table in task.stages),
        tau=tau,
    )


def _grasp(
    model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"], choice: _Choice
) -> Float[np.ndarray, "4 4"]:
    """Tool at the grasp, pointing down."""
    yaw = float(np.arctan2(T_base_object[1, 0], T_base_object[0, 0]))
    yaws = sorted(
        (yaw + k * model.grasp_turn_rad for k in range(round(2 * np.pi / model.grasp_turn_rad))),
        key=lambda angle: abs(np.mod(angle + np.pi, 2 * np.pi) - np.pi),
    )
    T = _tool_down(yaws[choice.turns % len(yaws)])
    local = np.array(model.grasp_m) + np.array([*choice.shift_m, 0.0])
    p = T_base_object[:3, 3] + np.array([0.0, 0.0, local[2]])
    p[:2] += T_base_object[:2, :2] @ local[:2]
    T[:3, 3] = p + T[:3, 0] * choice.aside_m
    T[2, 3] = max(T[2, 3], LOWEST_TOOL_M)
    return T


def _tool_down(yaw_rad: float) -> Float[np.ndarray, "4 4"]:
    """Tool z down, y across the fingers along the base's y at yaw 0."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T = np.eye(4)
    T[:3, :3] = np.array([[-c, -s, 0.0], [-s, c, 0.0], [0.0, 0.0, -1.0]])
    return T


def _release(
    problem: Problem,
    key: str,
    T_base_object: Float[np.ndarray, "4 4"],
    T_grasp: Float[np.ndarray, "4 4"],
    choice: _Choice,
    there: dict[str, Float[np.ndarray, "4 4"]],
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """Object as it comes to lie, and tool as it lets go."""
    task = problem.scene.task
    goal = task.goal_of(key)
    if goal is None:
        raise NoPlanError(
            f"no predicate of task {task.name} says what {key} belongs in or on, and the policy "
            f"{POLICY} knows no other place. {_OTHER_POLICY}"
        )
    relation, target_id = goal
    if relation not in ("inside", "on") or target_id not in task.objects:
        raise NoPlanError(
            f"the policy {POLICY} puts things into or onto others, and task {task.name} wants "
            f"{key} {relation} {target_id}. {_OTHER_POLICY}"
        )
    target, T_target = task.objects[target_id], there[target_id]
    model = task.objects[key]
    top_m = float(T_target[2, 3]) + target.size_m[2] - target.rest_height_m
    over_m = OVER_RIM_M if relation == "inside" else OVER_TOP_M
    middle = T_target[:2, 3] + T_target[:2, :2] @ np.array(choice.release_m)
    T_tool = T_grasp.copy()
    T_tool[:2, 3] = middle + (T_grasp[:2, 3] - T_base_object[:2, 3])
    below_tool_m = float(T_grasp[2, 3] - T_base_object[2, 3]) + model.rest_height_m
    T_tool[2, 3] = top_m + over_m + below_tool_m
    lies = T_base_object.copy()
    lies[:2, 3] = middle
    floor_m = float(T_target[2, 3]) + target.wall_m if relation == "inside" else top_m
    lies[2, 3] = floor_m + model.rest_height_m
    return lies, T_tool


def _legs(
    problem: Problem, key: str, choice: _Choice, there: dict[str, Float[np.ndarray, "4 4"]]
) -> list[_Leg]:
    """The movements for one object; ``there`` then has it where it comes to lie."""
    task = problem.scene.task
    ids = stages_of(task, key)
    grasp = _grasp(task.objects[key], there[key], choice)
    lies, low = _release(problem, key, there[key], grasp, choice, there)
    there[key] = lies
    pick, place = ids["grasp"], ids["release"]
    carried, over = _at_height(grasp, choice.carry_m), _at_height(low, choice.carry_m)
    return [
        _Leg(stage=pick, T_base_tcp=_at_height(grasp, grasp[2, 3] + HOVER_M), g=0),
        _Leg(stage=pick, T_base_tcp=grasp, g=0),
        _Leg(stage=pick, T_base_tcp=grasp, g=0, pause_s=0.2),
        _Leg(stage=pick, T_base_tcp=grasp, g=1, pause_s=0.7),
        _Leg(stage=pick, T_base_tcp=carried, g=1),
        _Leg(stage=ids.get("carry", place), T_base_tcp=over, g=1),
        _Leg(stage=place, T_base_tcp=low, g=1),
        _Leg(stage=place, T_base_tcp=low, g=1, pause_s=0.2),
        _Leg(stage=place, T_base_tcp=low, g=0, pause_s=0.5),
        _Leg(stage=place, T_base_tcp=over, g=0),
    ]


def _push_legs(
    problem: Problem, key: str, choice: _Choice, there: dict[str, Float[np.ndarray, "4 4"]]
) -> list[_Leg]:
    """Down behind the object with closed fingers, straight on to its mark, back and up."""
    task, T = problem.scene.task, there[key]
    mark = task.mark_of(key)
    if mark is None:
        raise NoPlanError(
            f"nothing in task {task.name} says where {key} is to be pushed. Add a success "
            "predicate moved with target_m to the task file (docs/tasks.md)."
        )
    stage = stages_of(task, key)["push"]
    table = next(each for each in task.stages if each["id"] == stage)
    to = np.array(mark) + np.array(choice.release_m)
    way = to - T[:2, 3]
    far_m = float(np.linalg.norm(way))
    if far_m < PUSH_GAP_M:
        raise NoPlanError(
            f"{key} lies {far_m * 1e3:.0f} mm from its mark, too near to be pushed: at least "
            f"{PUSH_GAP_M * 1e3:.0f} mm are needed. Put it farther away."
        )
    along = way / far_m
    half = np.array(task.objects[key].size_m[:2]) / 2
    local = np.abs(T[:2, :2].T @ along)
    reach_m = float(np.min(half / np.maximum(local, 1e-9))) + FINGERS_HALF_M
    aside = np.array([-along[1], along[0]]) * choice.aside_m
    tool = _tool_down(float(np.arctan2(along[1], along[0])) + np.pi * (choice.turns % 2))
    height_m = problem.scene.table_height_m + LOWEST_TOOL_M + PUSH_OVER_M

    def at(p: Float[np.ndarray, "2"], up_m: float = 0.0) -> Float[np.ndarray, "4 4"]:
        T_tool = tool.copy()
        T_tool[:3, 3] = [*p, height_m + up_m]
        return T_tool

    behind = T[:2, 3] - (reach_m + PUSH_GAP_M) * along + aside
    ahead = to - reach_m * along + aside
    back = ahead - PUSH_GAP_M * along
    there[key] = T.copy()
    there[key][:2, 3] = to
    speed = float(table.get("speed_m_s", PUSH_SPEED_M_S))
    return [
        _Leg(stage=stage, T_base_tcp=at(behind, HOVER_M), g=1),
        _Leg(stage=stage, T_base_tcp=at(behind), g=1),
        _Leg(stage=stage, T_base_tcp=at(ahead), g=1, even_m_s=speed),
        _Leg(stage=stage, T_base_tcp=at(ahead), g=1, pause_s=0.3),
        _Leg(stage=stage, T_base_tcp=at(back), g=1),
        _Leg(stage=stage, T_base_tcp=at(back, HOVER_M), g=1),
    ]


def _at_height(T: Float[np.ndarray, "4 4"], height_m: float) -> Float[np.ndarray, "4 4"]:
    raised = T.copy()
    raised[2, 3] = height_m
    return raised


def _followed(
    problem: Problem, legs: Sequence[_Leg], start_rad: Float[np.ndarray, " num_joints"]
) -> tuple[tuple[Waypoint, ...], dict[str, tuple[int, int]]]:
    """Waypoints along the legs, and when each stage begins and ends."""
    robot = problem.robot
    T, joints, t_s = robot.T_base_tcp(start_rad), start_rad, 0.0
    tau = [_waypoint(0.0, T, legs[0].g, joints)]
    bounds: dict[str, tuple[int, int]] = {}
    for leg in legs:
        seconds, law = _law(T, leg)
        steps = len(law)
        u = np.arange(1, steps + 1) / steps
        ends = np.array([T, leg.T_base_tcp])
        line = PoseTrajectory(
            np.array([0, 10**9], dtype=np.int64),
            ends[:, :3, 3],
            np.array([se3.quaternion_from_rotation(each[:3, :3]) for each in ends]),
        )
        begin_ns = round(t_s * 1e9)
        for share, pose in zip(u, line.at((law * 1e9).astype(np.int64)).transforms(), strict=True):
            solution = solve_ik(robot, pose, IkConfig(), warm_start_rad=joints)
            if not solution.reached or np.abs(solution.joints_rad - joints).max() > 0.3:
                x, y, z = pose[:3, 3]
                raise NoPlanError(
                    f"the arm cannot follow to ({x:.3f}, {y:.3f}, {z:.3f}) m in stage "
                    f"{leg.stage}. Move the object, or where it goes, nearer to the arm."
                )
            joints = solution.joints_rad
            tau.append(_waypoint(t_s + float(share) * seconds, pose, leg.g, joints))
        t_s += seconds
        T = leg.T_base_tcp
        bounds[leg.stage] = (bounds.get(leg.stage, (begin_ns, 0))[0], round(t_s * 1e9))
    return tuple(tau), bounds


def _law(T: Float[np.ndarray, "4 4"], leg: _Leg) -> tuple[float, Float[np.ndarray, " num_steps"]]:
    """How long a leg takes, and which share of its way is done after each step."""
    if leg.even_m_s is None:
        steps = max(1, round((leg.pause_s or _duration_s(T, leg.T_base_tcp)) / STEP_S))
        u = np.arange(1, steps + 1) / steps
        return steps * STEP_S, u**3 * (10 - 15 * u + 6 * u**2)  # with little jerk
    far_m = float(np.linalg.norm(leg.T_base_tcp[:3, 3] - T[:3, 3]))
    seconds = far_m / leg.even_m_s + RAMP_S
    ramp = RAMP_S / seconds
    steps = max(1, round(seconds / PUSH_STEP_S))
    u = np.arange(1, steps + 1) / steps
    begins, ends = np.minimum(u, ramp), np.maximum(u - 1 + ramp, 0.0)
    done = u - begins + begins**2 / (2 * ramp) - ends**2 / (2 * ramp)
    return seconds, done / (1 - ramp)


def _duration_s(T: Float[np.ndarray, "4 4"], T_next: Float[np.ndarray, "4 4"]) -> float:
    far_m = float(np.linalg.norm(T_next[:3, 3] - T[:3, 3]))
    turn_rad = float(se3.rotation_angle_rad(T[:3, :3].T @ T_next[:3, :3]))
    return max(SHORTEST_S, far_m / SPEED_M_S, turn_rad / TURN_RAD_S)


def _waypoint(
    t_s: float,
    T: Float[np.ndarray, "4 4"],
    g: int,
    joints_rad: Float[np.ndarray, " num_joints"],
) -> Waypoint:
    x, y, z = T[:3, 3].tolist()
    w, i, j, k = se3.quaternion_from_rotation(T[:3, :3]).tolist()
    return Waypoint(
        t_ns=round(t_s * 1e9),
        p_m=(x, y, z),
        q_wxyz=(w, i, j, k),
        g=g,
        joints_rad=tuple(joints_rad.tolist()),
    )
