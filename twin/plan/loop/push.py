"""Pushing straight, tool down, fingers closed: down behind the object, on to its mark, back."""

from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.plan.grasp.reach import nearest_solutions
from twin.plan.grasp.search import turned
from twin.plan.loop.tau import CLOSED_M, Trajectory, speed_limit, stages_of
from twin.plan.path.planner import Mover, NoPathError, PathConfig, first_free, reversed_path
from twin.plan.path.transfer import Leg, left_with
from twin.plan.path.world import Carried
from twin.plan.problem import Joints, NoPlanError, Pose, Poses, Problem, TimedPath
from twin.replay.clearance.bodies import GRIPPER

HOVER_M = 0.13
TOOL_OVER_TABLE_M = 0.02
"""The tips reach 10 mm below the tool."""
PUSH_GAP_M, FINGERS_HALF_M = 0.03, 0.011
"""Before the fingers meet what they push; of the closed pads."""
PUSH_SPEED_M_S = 0.1
"""Of a push whose task says no speed."""
WAIT_S = 0.3
ASIDE_M = (0.0, 0.012, -0.012)
"""Of the fingers, along the pads, from the middle of the object."""
AHEAD_M = ((0.0, 0.0), (0.015, 0.0), (-0.015, 0.0), (0.0, 0.015), (0.0, -0.015))
"""Of the end from the mark."""

Choice = tuple[float, float, tuple[float, float]]
"""What one candidate does to every object: how far it is from what the task says, the fingers
aside, and the end ahead of the mark [m]."""


def push_choices() -> list[Choice]:
    """All candidates, the least shifted first."""
    found = product(ASIDE_M, AHEAD_M)
    every = [(abs(aside) + float(np.linalg.norm(ahead)), aside, ahead) for aside, ahead in found]
    return sorted(every, key=lambda choice: choice[0])


def push(problem: Problem, key: str, choice: Choice, trajectory: Trajectory) -> Problem:
    """Append one push; return the problem as it leaves it."""
    task, T = problem.scene.task, problem.scene.Ts_base_object[key]
    stage, mark = stages_of(task, key).get("push"), task.mark_of(key)
    if stage is None:
        raise NoPlanError(f"task {task.name} pushes some objects and carries {key}: make it two.")
    if mark is None:
        raise NoPlanError(
            f"nothing in task {task.name} says where {key} is to be pushed. Add a success "
            "predicate moved with target_m to the task file (docs/tasks.md)."
        )
    _, aside_m, ahead_m = choice
    to = np.array(mark) + np.array(ahead_m)
    far_m = float(np.linalg.norm(to - T[:2, 3]))
    if far_m < PUSH_GAP_M:
        raise NoPlanError(
            f"{key} lies {far_m * 1e3:.0f} mm from its mark, too near to be pushed: at least "
            f"{PUSH_GAP_M * 1e3:.0f} mm are needed. Put it farther away."
        )
    T_lies = T.copy()
    T_lies[:2, 3] = to
    after = left_with(problem, key, T_lies)
    table = next(each for each in task.stages if each["id"] == stage)
    speed_m_s = float(table.get("speed_m_s", PUSH_SPEED_M_S))
    config = PathConfig(tool_m_s=speed_limit(task, stage))
    tools = _tools(problem, key, aside_m, (to - T[:2, 3]) / far_m, far_m)
    paths = _paths(problem, after, key, tools, speed_m_s, config)
    for number, path in enumerate(paths):
        trajectory.add(Leg(name="push", path=path, g=1, width_m=CLOSED_M), stage, CLOSED_M)
        if number == len(paths) - 3:
            trajectory.pause(stage, WAIT_S, g=1, width_m=CLOSED_M)
    return left_with(after, key, T_lies, paths[-1].joints_rad[-1])


def _tools(
    problem: Problem, key: str, aside_m: float, along: Float[np.ndarray, "2"], far_m: float
) -> Poses:
    """The tool behind the object, where it touches it, at the end, and drawn back from there."""
    T, half = problem.scene.Ts_base_object[key], np.array(problem.model(key).size_m[:2]) / 2
    local = np.abs(T[:2, :2].T @ along)
    reach_m = float(np.min(half / np.maximum(local, 1e-9))) + FINGERS_HALF_M
    c, s = along
    tools = np.tile(np.eye(4), (4, 1, 1))  # z down, y across the fingers
    tools[:, :3, :3] = [[-c, -s, 0.0], [-s, c, 0.0], [0.0, 0.0, -1.0]]
    tools[:, 2, 3] = problem.scene.table_height_m + TOOL_OVER_TABLE_M
    middle = T[:2, 3] + np.array([-s, c]) * aside_m
    ways_m = np.array([-PUSH_GAP_M, 0.0, far_m, far_m - PUSH_GAP_M])
    tools[:, :2, 3] = middle + (ways_m - reach_m)[:, None] * along
    return tools


def _paths(
    problem: Problem,
    after: Problem,
    key: str,
    tools: Poses,
    speed_m_s: float,
    config: PathConfig,
) -> list[TimedPath]:
    """Around, down, on to the object, with it to its mark, back and up."""
    robot, start = problem.robot, problem.scene.start_rad
    start_rad = robot.home_rad if start is None else start
    allowed = problem.contacts_of("push", key) | {frozenset((GRIPPER, key))}
    free = Mover(problem=problem, config=config, width_m=CLOSED_M)
    hand = replace(free, allowed=allowed)
    leaving = replace(hand, problem=after)

    def paths(way: tuple[Poses, Joints]) -> list[TimedPath]:
        (behind, touching, end, back), joints_rad = way
        T_tcp_object = se3.invert(touching) @ problem.scene.Ts_base_object[key]
        pushing = replace(hand, carried=Carried(object_id=key, T_tcp_object=T_tcp_object))
        rise = hand.straight(joints_rad, _raised(behind))
        around = free.around(start_rad, rise.joints_rad[-1:])
        near = hand.straight(joints_rad, touching)
        pushed = pushing.straight(near.joints_rad[-1], end, tool_m_s=speed_m_s)
        away = leaving.straight(pushed.joints_rad[-1], back)
        up = leaving.straight(away.joints_rad[-1], _raised(back))
        return [around, reversed_path(rise), near, pushed, away, up]

    ways = (
        (hands, joints_rad)
        for hands in (tools, turned(tools))
        for joints_rad in nearest_solutions(robot, hands[0], start_rad)
    )
    try:
        return first_free(ways, paths, "no joints reach behind it")
    except NoPathError as error:
        error.leg = "push"
        raise


def _raised(T: Pose) -> Pose:
    found = T.copy()
    found[2, 3] += HOVER_M
    return found
