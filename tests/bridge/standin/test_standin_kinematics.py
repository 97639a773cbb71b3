"""The controller's kinematics against MuJoCo, which builds the arm on its own."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.sources.standin import planner
from bridge.sources.standin.cell_file import CellFile, HiddenParameters
from bridge.sources.standin.kinematics import (
    UnreachablePoseError,
    arm_kinematics,
    tool_down,
    yaw_of,
)
from bridge.sources.standin.world import World
from bridge.task.plan import Plan
from bridge.task.task_file import Task

HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])


@pytest.fixture(scope="module")
def world(task: Task, nominal: HiddenParameters) -> World:
    return World(task, nominal)


@pytest.fixture
def plan_of(task: Task, starts: dict[str, np.ndarray], cell_file: CellFile) -> Callable[..., Plan]:
    def plan(error: planner.GraspError = planner.NO_ERROR, **more: Any) -> Plan:
        return planner.plan_pick_and_place(
            task,
            starts,
            error,
            kinematics=arm_kinematics(),
            joints_start_rad=HOME,
            max_joint_speed_rad_s=cell_file.max_joint_speed_rad_s,
            plan_id="plan_0",
            condition="without_replanning",
            start_id="cube_into_box/9000000",
            **more,
        )

    return plan


def test_forward_kinematics_agree_with_mujoco(world: World, starts: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(9_000_000)
    for joints in rng.uniform(-np.pi, np.pi, (20, 6)):
        world.reset(joints, starts)
        difference = world.T_base_body("tcp") - arm_kinematics().T_base_tcp(joints)
        assert np.abs(difference).max() < 1e-9


def test_every_waypoint_reaches_its_commanded_pose(
    plan_of: Callable[..., Plan], world: World, starts: dict[str, np.ndarray]
) -> None:
    plan = plan_of()
    commanded = se3.transform_from(plan.quaternions_wxyz(), plan.positions_m())
    for waypoint, T in list(zip(plan.tau, commanded, strict=True))[::5]:
        world.reset(np.array(waypoint.joints_rad), starts)
        reached = world.T_base_body("tcp")
        assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) < 0.0005
        assert se3.rotation_angle_rad(reached[:3, :3].T @ T[:3, :3]) < 0.001


def test_no_joint_moves_faster_than_the_cell_allows(
    plan_of: Callable[..., Plan], cell_file: CellFile
) -> None:
    plan = plan_of()
    joints = np.array([waypoint.joints_rad for waypoint in plan.tau])
    speed = np.abs(np.diff(joints, axis=0)) / (np.diff(plan.times_ns())[:, None] * 1e-9)
    assert speed.max() <= cell_file.max_joint_speed_rad_s + 1e-9


def test_a_grasp_is_never_turned_more_than_an_eighth_from_the_cube(
    plan_of: Callable[..., Plan], starts: dict[str, np.ndarray]
) -> None:
    closed = next(waypoint for waypoint in plan_of().tau if waypoint.g == 1)
    T = se3.transform_from(np.array(closed.q_wxyz), np.array(closed.p_m))
    # Tool x at yaw 0 points along -x of the base.
    turn = (yaw_of(T) - np.pi - yaw_of(starts["cube"])) % (np.pi / 2)
    assert min(turn, np.pi / 2 - turn) < 1e-6


def test_the_error_of_a_candidate_depends_on_start_and_round_only(
    cell_file: CellFile, starts: dict[str, np.ndarray]
) -> None:
    noise = cell_file.planner
    first = planner.draw_error(noise, start_seed=9_000_001, round_=0)
    assert first == planner.draw_error(noise, start_seed=9_000_001, round_=0)
    assert first != planner.draw_error(noise, start_seed=9_000_001, round_=1)
    seen = [planner.perceive(starts, noise, start_seed=9_000_001)["cube"] for _ in range(2)]
    np.testing.assert_array_equal(*seen)
    assert not np.array_equal(seen[0], starts["cube"])


def test_a_pose_out_of_reach_is_refused_with_its_position() -> None:
    far = tool_down(np.array([1.4, 0.0, 0.2]), 0.0)
    with pytest.raises(UnreachablePoseError, match=r"cannot reach \(1.400, 0.000, 0.200\)"):
        arm_kinematics().joints_for(far, HOME)


def test_a_wrist_that_is_wound_up_turns_back_before_the_next_object(
    ducks: Task, toys_cell: CellFile
) -> None:
    def lying(p_m: tuple[float, float, float], yaw: float) -> np.ndarray:
        q = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        return se3.transform_from(q, np.array(p_m))

    # Each of these turns is reached alone; with both, the wrist has no way to the second's basket.
    yaws = (-1.22, -1.18, 0.3, 1.02, -0.6)
    seen = {"basket": lying((0.46, 0.24, 0.0), 0.15)}
    for name, yaw in zip(ducks.manipulated, yaws, strict=True):
        start = ducks.start[name]
        seen[name] = lying((np.mean(start.x_m), np.mean(start.y_m), 0.03), yaw)
    limit = toys_cell.max_joint_speed_rad_s
    plan = planner.plan_pick_and_place(
        ducks,
        seen,
        replace(planner.NO_ERROR, release_m=(-0.08, 0.04)),
        kinematics=arm_kinematics(),
        joints_start_rad=HOME,
        max_joint_speed_rad_s=limit,
        plan_id="plan_0",
        condition="without_replanning",
        start_id="five_ducks_into_basket/9000000",
    )
    joints = np.array([waypoint.joints_rad for waypoint in plan.tau])
    assert np.abs(joints).max() <= np.pi + 1e-9
    speed = np.abs(np.diff(joints, axis=0)) / (np.diff(plan.times_ns())[:, None] * 1e-9)
    assert speed.max() <= limit + 1e-9
    wrist = dict(zip((stage.id for stage in plan.stages), _wrist_ways(plan), strict=True))
    assert wrist["pick_2"] > 2.0  # most of the way round, instead of past the limit
    grasped = [stage.id for stage in plan.stages if stage.grasp]
    assert grasped == [f"pick_{index}" for index in range(1, 6)]


def _wrist_ways(plan: Plan) -> list[float]:
    """How far the last joint turns in each stage [rad]."""
    times, last = plan.times_ns(), np.array([waypoint.joints_rad[5] for waypoint in plan.tau])
    return [
        float(np.ptp(last[(times >= stage.t_start_ns) & (times <= stage.t_end_ns)]))
        for stage in plan.stages
    ]


def test_a_pose_that_winds_a_joint_past_its_limit_names_the_joint() -> None:
    kinematics = arm_kinematics()
    wound = HOME.copy()
    wound[5] = 3.13
    past = wound.copy()
    past[5] = 3.16
    with pytest.raises(UnreachablePoseError, match="mm off with wrist_3_joint past 180 deg"):
        kinematics.joints_for(kinematics.T_base_tcp(past), wound)
