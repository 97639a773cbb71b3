"""Pushing straight, tool down, fingers closed: down behind the object, on to its mark, back."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.plan.grasp.reach import nearest_solutions
from twin.plan.loop.tau import CLOSED_M, Trajectory, speed_limit, stages_of
from twin.plan.path.planner import Mover, NoPathError, PathConfig, reversed_path
from twin.plan.path.transfer import Leg
from twin.plan.path.world import Carried
from twin.plan.problem import NoPlanError, Pose, Problem, TimedPath
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


@dataclass(frozen=True, kw_only=True)
class PushChoice:
    """What one candidate does to every object."""

    turned: bool
    """The hand, half about its approach."""
    aside_m: float
    ahead_m: tuple[float, float]

    @property
    def cost(self) -> float:
        """How far it is from what the task says."""
        return 0.1 * self.turned + abs(self.aside_m) + float(np.linalg.norm(self.ahead_m))


def push_choices() -> Iterator[PushChoice]:
    """All candidates, the least turned and shifted first."""
    everything = [
        PushChoice(turned=turned, aside_m=aside, ahead_m=ahead)
        for turned, aside, ahead in product((False, True), ASIDE_M, AHEAD_M)
    ]
    yield from sorted(everything, key=lambda choice: choice.cost)


def push(problem: Problem, key: str, choice: PushChoice, trajectory: Trajectory) -> Problem:
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
    to = np.array(mark) + np.array(choice.ahead_m)
    far_m = float(np.linalg.norm(to - T[:2, 3]))
    if far_m < PUSH_GAP_M:
        raise NoPlanError(
            f"{key} lies {far_m * 1e3:.0f} mm from its mark, too near to be pushed: at least "
            f"{PUSH_GAP_M * 1e3:.0f} mm are needed. Put it farther away."
        )
    T_lies = T.copy()
    T_lies[:2, 3] = to
    lying = {**problem.scene.Ts_base_object, key: T_lies}
    after = replace(problem, scene=replace(problem.scene, Ts_base_object=lying))
    table = next(each for each in task.stages if each["id"] == stage)
    speed_m_s = float(table.get("speed_m_s", PUSH_SPEED_M_S))
    tools = _tools(problem, key, choice, (to - T[:2, 3]) / far_m, far_m)
    config = PathConfig(tool_m_s=speed_limit(task, stage))
    paths = _paths(problem, after, key, tools, speed_m_s, config)
    for number, path in enumerate(paths):
        trajectory.add(Leg(name="push", path=path, g=1, width_m=CLOSED_M), stage, CLOSED_M)
        if number == len(paths) - 3:
            trajectory.pause(stage, WAIT_S, g=1, width_m=CLOSED_M)
    end_rad = paths[-1].joints_rad[-1]
    return replace(after, scene=replace(after.scene, start_rad=end_rad))


def _tools(
    problem: Problem, key: str, choice: PushChoice, along: Float[np.ndarray, "2"], far_m: float
) -> list[Pose]:
    """The tool behind the object, where it touches it, at the end, and drawn back from there."""
    T, half = problem.scene.Ts_base_object[key], np.array(problem.model(key).size_m[:2]) / 2
    local = np.abs(T[:2, :2].T @ along)
    reach_m = float(np.min(half / np.maximum(local, 1e-9))) + FINGERS_HALF_M
    c, s = along * (-1.0 if choice.turned else 1.0)
    tool = np.eye(4)  # z down, y across the fingers
    tool[:3, :3] = [[-c, -s, 0.0], [-s, c, 0.0], [0.0, 0.0, -1.0]]
    tool[2, 3] = problem.scene.table_height_m + TOOL_OVER_TABLE_M
    middle = T[:2, 3] + np.array([-along[1], along[0]]) * choice.aside_m
    found = []
    for way_m in (-PUSH_GAP_M, 0.0, far_m, far_m - PUSH_GAP_M):
        at = tool.copy()
        at[:2, 3] = middle + (way_m - reach_m) * along
        found.append(at)
    return found


def _paths(
    problem: Problem,
    after: Problem,
    key: str,
    tools: list[Pose],
    speed_m_s: float,
    config: PathConfig,
) -> list[TimedPath]:
    """Around, down, on to the object, with it to its mark, back and up."""
    behind, touching, end, back = tools
    robot = problem.robot
    start = problem.scene.start_rad
    start_rad = robot.home_rad if start is None else start
    allowed = problem.contacts_of("push", key) | {frozenset((GRIPPER, key))}
    free = Mover(problem=problem, config=config, width_m=CLOSED_M)
    hand = replace(free, allowed=allowed)
    T = problem.scene.Ts_base_object[key]
    held = Carried(object_id=key, T_tcp_object=se3.invert(touching) @ T)
    failure = NoPathError(reason="unreachable", detail="no joints reach behind it")
    for joints_rad in nearest_solutions(robot, behind, start_rad):
        try:
            rise = hand.straight(joints_rad, _raised(behind))
            around = free.around(start_rad, rise.joints_rad[-1:])
            near = hand.straight(joints_rad, touching)
            pushing = replace(hand, carried=held)
            pushed = pushing.straight(near.joints_rad[-1], end, tool_m_s=speed_m_s)
            leaving = replace(hand, problem=after)
            away = leaving.straight(pushed.joints_rad[-1], back)
            up = leaving.straight(away.joints_rad[-1], _raised(back))
        except NoPathError as error:
            failure = error
            continue
        return [around, reversed_path(rise), near, pushed, away, up]
    failure.leg = "push"
    raise failure


def _raised(T: Pose) -> Pose:
    found = T.copy()
    found[2, 3] += HOVER_M
    return found
