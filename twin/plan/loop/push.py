"""Pushing straight, tool down: down behind the object with closed fingers, on to its mark, back.

It looks at no distance and knows no surface; nothing is drawn.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.plan import Waypoint
from twin.plan.loop.propose import NoPlanError
from twin.plan.loop.tau import stages_of
from twin.plan.path.planner import waypoint
from twin.plan.problem import Joints, Numbers, Pose, Problem
from twin.robot.config import IkConfig
from twin.robot.follow import follow_poses

STEP_S = 0.04
HOVER_M = 0.13
LOWEST_TOOL_M = 0.016
"""The tips reach 10 mm below the tool."""
SPEED_M_S, TURN_RAD_S = 0.25, 1.0
SHORTEST_S = 0.5
PUSH_GAP_M, PUSH_OVER_M, FINGERS_HALF_M = 0.03, 0.004, 0.011
"""Before the fingers meet what they push; of the tool over its lowest place; of the closed pads."""
PUSH_SPEED_M_S, RAMP_S, PUSH_STEP_S = 0.1, 0.12, 0.02
"""Of a push whose task says no speed; time to reach it and to stop; between its waypoints."""
WAIT_S = 0.3
MOST_STEP_RAD = 0.3
ASIDE_M = (0.0, 0.012, -0.012)
"""Of the fingers, along the pads, from the middle of the object."""
AHEAD_M = ((0.0, 0.0), (0.015, 0.0), (-0.015, 0.0), (0.0, 0.015), (0.0, -0.015))
"""Of the end from the mark."""


@dataclass(frozen=True, kw_only=True)
class PushChoice:
    """What one candidate does to every object."""

    turns: int
    aside_m: float
    ahead_m: tuple[float, float]

    @property
    def cost(self) -> float:
        """How far it is from what the task says."""
        return 0.1 * self.turns + abs(self.aside_m) + float(np.linalg.norm(self.ahead_m))


@dataclass(frozen=True, kw_only=True)
class _Leg:
    stage: str
    T_base_tcp: Pose
    g: int = 1
    pause_s: float = 0.0
    even_m_s: float | None = None
    """Goes at this speed but for short ramps; None: slowly, at rest at both ends."""


def push_choices(problem: Problem) -> Iterator[PushChoice]:
    """All candidates, the least turned and shifted first."""
    task = problem.scene.task
    turns = max(round(2 * np.pi / task.objects[key].grasp_turn_rad) for key in task.manipulated)
    everything = [
        PushChoice(turns=turn, aside_m=aside, ahead_m=ahead)
        for turn, aside, ahead in product(range(turns), ASIDE_M, AHEAD_M)
    ]
    yield from sorted(everything, key=lambda choice: choice.cost)


def pushed(
    problem: Problem, choice: PushChoice
) -> tuple[tuple[Waypoint, ...], dict[str, tuple[int, int]], dict[str, Pose]]:
    """Waypoints, when each stage begins and ends [ns], and where everything then lies."""
    scene, robot = problem.scene, problem.robot
    start_rad = robot.home_rad if scene.start_rad is None else scene.start_rad
    there = dict(scene.Ts_base_object)
    legs: list[_Leg] = []
    for key in scene.task.manipulated:
        legs += _push_legs(problem, key, choice, there)
    legs.append(_Leg(stage=legs[-1].stage, T_base_tcp=robot.T_base_tcp(start_rad), g=0))
    tau, bounds = _followed(problem, legs, start_rad)
    return tau, bounds, there


def _push_legs(
    problem: Problem, key: str, choice: PushChoice, there: dict[str, Pose]
) -> list[_Leg]:
    """The movements for one object; ``there`` then has it where it comes to lie."""
    task, T = problem.scene.task, there[key]
    mark = task.mark_of(key)
    if mark is None:
        raise NoPlanError(
            f"nothing in task {task.name} says where {key} is to be pushed. Add a success "
            "predicate moved with target_m to the task file (docs/tasks.md)."
        )
    stage = stages_of(task, key).get("push")
    if stage is None:
        raise NoPlanError(f"task {task.name} pushes some objects and carries {key}: make it two.")
    table = next(each for each in task.stages if each["id"] == stage)
    to = np.array(mark) + np.array(choice.ahead_m)
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

    def at(p: Float[np.ndarray, "2"], up_m: float = 0.0) -> Pose:
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
        _Leg(stage=stage, T_base_tcp=at(behind, HOVER_M)),
        _Leg(stage=stage, T_base_tcp=at(behind)),
        _Leg(stage=stage, T_base_tcp=at(ahead), even_m_s=speed),
        _Leg(stage=stage, T_base_tcp=at(ahead), pause_s=WAIT_S),
        _Leg(stage=stage, T_base_tcp=at(back)),
        _Leg(stage=stage, T_base_tcp=at(back, HOVER_M)),
    ]


def _tool_down(yaw_rad: float) -> Pose:
    """Tool z down, y across the fingers along the base's y at yaw 0."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T = np.eye(4)
    T[:3, :3] = np.array([[-c, -s, 0.0], [-s, c, 0.0], [0.0, 0.0, -1.0]])
    return T


def _followed(
    problem: Problem, legs: Sequence[_Leg], start_rad: Joints
) -> tuple[tuple[Waypoint, ...], dict[str, tuple[int, int]]]:
    """Waypoints along the legs, and when each stage begins and ends."""
    robot = problem.robot
    T, joints, t_s = robot.T_base_tcp(start_rad), start_rad, 0.0
    tau = [waypoint(0.0, T, joints, g=legs[0].g)]
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
        Ts = line.at((law * 1e9).astype(np.int64)).transforms()
        found = follow_poses(robot, Ts, start_rad=joints, config=IkConfig())
        rows = np.vstack([joints, found.joints_rad])
        if not found.reached.all() or np.abs(np.diff(rows, axis=0)).max() > MOST_STEP_RAD:
            raise NoPlanError(
                f"the arm cannot follow stage {leg.stage}. Move the object, or where it goes, "
                "nearer to the arm."
            )
        for share, pose, row in zip(u, Ts, found.joints_rad, strict=True):
            tau.append(waypoint(t_s + float(share) * seconds, pose, row, g=leg.g))
        joints = rows[-1]
        t_s += seconds
        T = leg.T_base_tcp
        bounds[leg.stage] = (bounds.get(leg.stage, (begin_ns, 0))[0], round(t_s * 1e9))
    return tuple(tau), bounds


def _law(T: Pose, leg: _Leg) -> tuple[float, Numbers]:
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


def _duration_s(T: Pose, T_next: Pose) -> float:
    far_m = float(np.linalg.norm(T_next[:3, 3] - T[:3, 3]))
    turn_rad = float(se3.rotation_angle_rad(T[:3, :3].T @ T_next[:3, :3]))
    return max(SHORTEST_S, far_m / SPEED_M_S, turn_rad / TURN_RAD_S)
