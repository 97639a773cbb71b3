"""Grippers of several kinds: fingers are where their law puts the width, and press as told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.robots.default import FINGER_JOINTS
from bridge.robots.robot import Finger, Gripper, Robot, read_robot
from twin.physics import arm
from twin.physics.config import FINGER_SPEED_M_S, PhysicsConfig
from twin.physics.world import World
from twin.replay.dynamics import mesh_hulls
from twin.robot.collision import RobotHulls
from twin.robot.model import RobotModel

PANDA = read_robot("panda")


def opened(robot: Robot) -> tuple[World, RobotModel]:
    model = RobotModel(robot.description())
    world = World(model.urdf, mesh_hulls(RobotHulls(model)), PhysicsConfig())
    world.reset_robot(model.home_rad, robot.gripper.max_width_m)
    return world, model


def commanded(world: World, model: RobotModel, width_m: float, seconds: float = 1.0) -> None:
    for _ in range(round(seconds * world.config.rate_hz)):
        world.robot.command(model.home_rad, np.zeros(len(model.home_rad)), width_m)
        world.step()


@pytest.mark.parametrize(
    "name", ["panda", "z1", "so100", "so101", "xarm7_parallel_gripper", "ur10e_parallel_gripper"]
)
def test_the_fingers_go_to_the_width_that_they_are_told(name: str) -> None:
    robot = read_robot(name)
    world, model = opened(robot)
    with world:
        for width in (0.2 * robot.gripper.max_width_m, 0.7 * robot.gripper.max_width_m):
            commanded(world, model, width)
            joints, measured = world.robot.posture()
            assert measured == pytest.approx(width, abs=1e-3)
            assert world.robot.width_m() == measured
            np.testing.assert_allclose(joints, model.home_rad, atol=2e-3)
            for link in robot.gripper.finger_links:
                here = world.robot.T_base_link(link)
                expected = model.T_base_link(link, joints, measured)
                np.testing.assert_allclose(here[:3, 3], expected[:3, 3], atol=2e-3)


def squeezed_N(robot: Robot, thickness_m: float = 0.03) -> float:
    """What the fingers press with on a fixed block between them, mean of both."""
    world, model = opened(robot)
    with world:
        T = model.T_base_tcp(model.home_rad)
        block = np.array([0.02, thickness_m, 0.02])
        body = world.add_static([(np.zeros(3), block)], T)[0]
        commanded(world, model, 0.0, seconds=0.5)
        forces = [
            sum(
                point[9]
                for point in world.client.getContactPoints(world.robot.id, body, linkIndexA=link)
            )
            for link in world.robot.finger_links
        ]
        return float(np.mean(forces))


def test_the_grip_force_does_not_depend_on_how_the_fingers_are_driven() -> None:
    """Mimicked or each with its own law: the force of a finger is the task's."""
    wanted = PhysicsConfig().grip_force_N
    pair = tuple(Finger(joint=f"panda_finger_joint{k}") for k in (1, 2))
    both = replace(PANDA, name="mine", gripper=replace(PANDA.gripper, fingers=pair))
    for robot in (PANDA, both):
        assert squeezed_N(robot) == pytest.approx(wanted, rel=0.15)


LENGTH_M, HINGE_M, HALF_M = 0.1, 0.02, 0.006
"""From the hinges to the tool, between hinge and middle, half the thickness of a jaw."""


def jaws(folder: Path) -> Robot:
    """A UR10e with two jaws that turn, of which one mimics the other the other way round."""
    inertial = (
        '<inertial><mass value="0.1"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" '
        'izz="1e-4"/></inertial>'
    )
    box = (
        f'<collision><origin xyz="0 0 {LENGTH_M / 2}"/><geometry><box size="0.02 {2 * HALF_M} '
        f'{LENGTH_M + 0.02}"/></geometry></collision>'
    )
    parts = [
        f'<link name="{side}_jaw">{inertial}{box}</link><joint name="{side}_hinge" '
        f'type="revolute"><parent link="tool0"/><child link="{side}_jaw"/><origin '
        f'xyz="0 {place} 0.05"/><axis xyz="-1 0 0"/><limit lower="-0.8" upper="0.8" effort="9" '
        f'velocity="3"/>{mimic}</joint>'
        for side, place, mimic in (
            ("left", HINGE_M, ""),
            ("right", -HINGE_M, '<mimic joint="left_hinge" multiplier="-1"/>'),
        )
    ]
    tip = (
        f'<link name="tcp"/><joint name="tip" type="fixed"><parent link="tool0"/><child '
        f'link="tcp"/><origin xyz="0 0 {0.05 + LENGTH_M}"/></joint>'
    )
    (folder / "jaws.urdf").write_text(f'<robot name="jaws">{"".join(parts)}{tip}</robot>')
    finger = Finger(
        joint="left_hinge", turns=True, link_m=2 * LENGTH_M, offset_m=2 * (HINGE_M - HALF_M)
    )
    links = ("left_jaw", "right_jaw")
    arm = read_robot("ur10e_parallel_gripper")
    return replace(
        arm,
        name="jaws",
        urdf=str(arm.folder / "ur10e.urdf"),
        attached=(str(folder / "jaws.urdf"),),
        gripper=Gripper(links=links, finger_links=links, fingers=(finger,), max_width_m=0.1),
    )


def test_jaws_that_turn_open_as_wide_and_press_as_hard_as_those_that_slide(tmp_path: Path) -> None:
    robot = jaws(tmp_path)
    world, model = opened(robot)
    with world:
        for width in (0.09, 0.04):
            commanded(world, model, width)
            assert world.robot.width_m() == pytest.approx(width, abs=1e-3)
            T_base_tcp = model.T_base_tcp(model.home_rad)
            for link, side in (("left_jaw", 1.0), ("right_jaw", -1.0)):
                jaw = se3.invert(T_base_tcp) @ world.robot.T_base_link(link)
                end = se3.apply(jaw, np.array([[0.0, -side * HALF_M, LENGTH_M]]))[0]
                assert side * end[1] == pytest.approx(width / 2, abs=2e-3)
    assert squeezed_N(robot, 2 * (HINGE_M - HALF_M)) == pytest.approx(20.0, rel=0.2)


def test_a_fixed_tool_has_no_width_and_takes_no_orders() -> None:
    robot = read_robot("kinova_j2s6s200")
    world, model = opened(robot)
    with world:
        commanded(world, model, 0.05, seconds=0.1)
        joints, width = world.robot.posture()
        assert width == 0.0
        assert not world.robot.closing
        np.testing.assert_allclose(joints, model.home_rad, atol=5e-3)
        world.robot.press(0.8)
        world.step()


HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
SIZE = np.array([0.04, 0.04, 0.04])
STILL = np.zeros(6)
STRONG = PhysicsConfig(grip_force_N=30.0)
OPEN_M, CLOSED_M = 0.06, 0.0


def fingers(world: World) -> np.ndarray:
    """Speed [m/s] and force [N] of each finger."""
    names = {
        world.client.getJointInfo(world.robot.id, index)[1].decode(): (index)
        for index in range(world.client.getNumJoints(world.robot.id))
    }
    states = world.client.getJointStates(world.robot.id, [names[name] for name in FINGER_JOINTS])
    return np.array([[state[1], state[3]] for state in states])


def run(world: World, steps: int, width_m: float) -> np.ndarray:
    """Step, and return the speeds and forces on the way."""
    rows = []
    for _ in range(steps):
        world.robot.command(HOME, STILL, width_m)
        world.step()
        rows.append(fingers(world))
    return np.array(rows)


def holding(world: World) -> np.ndarray:
    """Close on a cube that floats between the fingers."""
    world.client.setGravity(0, 0, 0)
    world.reset_robot(HOME, OPEN_M)
    world.add_free("cube", SIZE, 0.05, world.robot.T_base_link("tcp"))
    run(world, 10, OPEN_M)
    return run(world, 120, CLOSED_M)


def test_the_whole_force_is_there_after_a_few_iterations(
    urdf: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = replace(STRONG, solver_iterations=20)
    with World(urdf, {}, few) as world:
        np.testing.assert_allclose(np.abs(holding(world)[-20:, :, 1]), 30.0, rtol=1e-6)
    monkeypatch.setattr(arm, "PATIENCE", 10**9)
    with World(urdf, {}, few) as world:
        assert np.abs(holding(world)[-20:, :, 1]).max() < 20.0, "at the usual speed it is not"


def test_fingers_keep_their_speed_until_they_meet_something(urdf: str) -> None:
    with World(urdf, {}, STRONG) as world:
        world.reset_robot(HOME, OPEN_M)
        run(world, 10, OPEN_M)
        speeds = np.abs(run(world, 60, CLOSED_M)[:, :, 0])
        assert speeds.max() < 1.05 * FINGER_SPEED_M_S
        assert speeds[:40].max() > 0.95 * FINGER_SPEED_M_S


def test_fingers_whose_cube_is_gone_are_slow_again_after_a_few_steps(urdf: str) -> None:
    with World(urdf, {}, STRONG) as world:
        holding(world)
        width_m = world.robot.width_m()
        world.client.resetBasePositionAndOrientation(
            world.free_ids["cube"], [2.0, 0.0, 1.0], [0, 0, 0, 1]
        )
        speeds = np.abs(run(world, 12, CLOSED_M)[:, :, 0])
        free_m_s = 1.05 * FINGER_SPEED_M_S
        assert (speeds.max(axis=1) > free_m_s).sum() <= arm.EVERY_STEPS
        usual_m = 2 * FINGER_SPEED_M_S * 12 / STRONG.rate_hz
        farthest_m = 2 * arm.EVERY_STEPS * arm.PRESS_M_S / STRONG.rate_hz
        assert world.robot.width_m() > width_m - usual_m - farthest_m - 1e-3
