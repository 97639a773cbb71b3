"""Both engines do what a replay asks of a world: fall, rest, grip, the same on every run."""

import hashlib
import subprocess
import sys
from importlib import util
from pathlib import Path

import numpy as np
import pytest
from cells import ENGINES, HOME, URDF, T_base_tcp, at, cell

from bridge.errors import MissingDependencyError, UsageError
from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from bridge.robots.robot import read_robot
from twin.physics import engine
from twin.physics.arm import Arm, PhysicsError, write_description
from twin.physics.config import PhysicsConfig, require_engine
from twin.physics.engines import open_world
from twin.physics.world import World
from twin.replay.config import ReplayConfig
from twin.replay.dynamics import mesh_hulls
from twin.robot.collision import hulls_of
from twin.robot.model import load_robot, with_absolute_meshes

CUBE = np.array([0.04, 0.04, 0.04])
each_engine = pytest.mark.parametrize("engine", ENGINES)
DROPPED = """
import sys
sys.path.insert(0, {folder!r})
from test_engines import dropped
print(*[dropped(engine) for engine in {engines!r}])
"""


def dropped(engine: str) -> str:
    """Hash of all poses of two cubes that fall on the table, and on each other."""
    digest = hashlib.sha256()
    with cell(engine) as world:
        world.add_table(0.0)
        world.add_free("low", CUBE, 0.05, at(0.5, 0.0, 0.05))
        world.add_free("high", CUBE, 0.05, at(0.51, 0.01, 0.12))
        world.reset_robot(HOME, 0.08)
        for _ in range(60):
            world.robot.command(HOME, np.zeros(6), 0.08)
            world.step()
            for name in ("low", "high"):
                digest.update(np.array(world.object_pose(name)).tobytes())
            digest.update(world.robot.posture()[0].tobytes())
    return digest.hexdigest()


def test_every_run_gives_the_same_bits_also_in_another_process() -> None:
    once = [dropped(engine) for engine in ENGINES]
    assert [dropped(engine) for engine in ENGINES] == once
    script = DROPPED.format(folder=str(Path(__file__).parent), engines=ENGINES)
    command = [sys.executable, "-c", script]
    other = subprocess.run(command, capture_output=True, text=True, check=True)
    assert other.stdout.split() == once


@each_engine
def test_the_arm_follows_a_fast_motion(engine: str) -> None:
    with cell(engine) as world:
        world.reset_robot(HOME, 0.05)
        t = np.arange(1, 241) / 240
        path = HOME + 0.5 * (1 - np.cos(np.pi * t))[:, None] * np.array([1, 0.5, -0.5, 1, 1, 1])
        before, off = HOME, []
        for target in path:
            world.robot.command(target, (target - before) * 240, 0.05)
            world.step()
            joints, width_m = world.robot.posture()
            off.append(np.abs(joints - target).max())
            before = target
    assert max(off) < 1e-2
    assert width_m == pytest.approx(0.05, abs=1e-4)


@each_engine
def test_fingers_close_on_a_cube_hold_it_and_let_it_go(engine: str) -> None:
    with cell(engine) as world:
        world.reset_robot(HOME, 0.06)
        T_tcp = T_base_tcp(world)
        world.add_free("cube", CUBE, 0.05, T_tcp)
        widths = []
        for _ in range(240):
            # Held where it is until the fingers are there: 0.1 s of a fall is 5 cm.
            world.robot.command(HOME, np.zeros(6), 0.02)
            world.step()
            widths.append(world.robot.width_m())
            if world.finger_touches("cube"):
                break
        closing_m_s = (0.06 - widths[-1]) / len(widths) * 240
        assert closing_m_s <= 2 * 0.1 * 1.05, "each finger goes by 0.1 m/s at most"
    with cell(engine) as world:
        world.reset_robot(HOME, 0.041)
        world.add_free("cube", CUBE, 0.05, T_base_tcp(world))
        for _ in range(240):
            world.robot.command(HOME, np.zeros(6), 0.0)
            world.step()
        assert world.robot.width_m() == pytest.approx(0.04, abs=1e-3)
        assert world.finger_touches("cube")
        fallen = T_base_tcp(world)[2, 3] - world.T_base_object("cube")[2, 3]
        assert abs(fallen) < 4e-3
        for _ in range(120):
            world.robot.command(HOME, np.zeros(6), 0.08)
            world.step()
        assert not world.finger_touches("cube")
        assert world.T_base_object("cube")[2, 3] < T_tcp[2, 3] - 0.2


@each_engine
@pytest.mark.parametrize(("mass_kg", "holds"), [(1.7, True), (2.3, False)])
def test_a_grip_holds_what_coulomb_says(engine: str, mass_kg: float, holds: bool) -> None:
    """Two pads with 20 N and friction 0.5 carry 20 N, which is 2.0 kg."""
    with cell(engine, object_friction=0.5) as world:
        world.reset_robot(HOME, 0.0401)
        world.add_free("cube", CUBE, mass_kg, T_base_tcp(world))
        for _ in range(240):
            world.robot.command(HOME, np.zeros(6), 0.0)
            world.step()
        fallen = T_base_tcp(world)[2, 3] - world.T_base_object("cube")[2, 3]
    assert (fallen < 0.01) == holds


@each_engine
def test_the_arm_feels_the_weight_of_what_it_holds_and_not_its_own_grip(engine: str) -> None:
    """Two pads of 20 N cancel out; what is left is the object's weight."""
    mass_kg, forces_N = 0.5, []
    with cell(engine) as world:
        world.reset_robot(HOME, 0.0401)
        world.add_free("cube", CUBE, mass_kg, T_base_tcp(world))
        for _ in range(240):
            world.robot.command(HOME, np.zeros(6), 0.0)
            world.step()
            forces_N.append(world.arm_force_N())
    assert np.mean(forces_N[120:]) == pytest.approx(mass_kg * 9.81, rel=0.05)


@each_engine
def test_a_tool_told_to_go_through_the_table_stops_on_it_within_its_torque(engine: str) -> None:
    over = np.array([0.0, -1.4, 1.9, -2.07, -1.57, 0.0])
    with cell(engine) as world:
        world.add_table(0.0)
        world.reset_robot(over, 0.02)
        height_m = T_base_tcp(world)[2, 3]
        into = over + np.array([0, 0.3, 0, -0.3, 0, 0])
        for step in range(480):
            share = min(1.0, step / 240)
            world.robot.command(over + share * (into - over), np.zeros(6), 0.02)
            world.step()
        low_m = T_base_tcp(world)[2, 3]
        joints, _ = world.robot.posture()
    assert height_m > 0.09
    # The tips are 10 mm below the tool's frame.
    assert -0.005 < low_m < 0.03
    assert np.isfinite(joints).all()


@each_engine
def test_a_description_without_fingers_is_refused_by_name(engine: str) -> None:
    with pytest.raises(PhysicsError, match="lacks gripper_left_finger_joint"):
        cell(engine, URDF.replace("gripper_left_finger_joint", "thumb_joint"))


@each_engine
def test_what_is_no_description_is_refused(engine: str) -> None:
    broken = URDF.replace('<parent link="gripper_base"', '<parent link="nowhere"', 1)
    with pytest.raises(PhysicsError, match="does not load the robot description"):
        cell(engine, broken)


@each_engine
def test_an_object_that_is_not_there_is_named_with_those_that_are(engine: str) -> None:
    with cell(engine) as world:
        world.add_free("cube", CUBE, 0.05, at(0.5, 0.0, 0.05))
        with pytest.raises(PhysicsError, match=r"no object 'duck'.*There are: cube"):
            world.object_pose("duck")


@pytest.mark.parametrize(
    ("name", "joint"), [("panda", "panda_finger_joint2"), ("z1", "jointGripper")]
)
def test_mujoco_refuses_fingers_that_mimic_or_turn_by_their_joint(name: str, joint: str) -> None:
    urdf = with_absolute_meshes(read_robot(name).description())
    with pytest.raises(PhysicsError, match=rf"{joint} turns or follows another joint"):
        open_world("mujoco", urdf, {}, PhysicsConfig())


@pytest.mark.parametrize("name", ["ur10_parallel_gripper", "kinova_j2s6s200"])
def test_mujoco_moves_other_arms_also_without_fingers(name: str) -> None:
    record = read_robot(name)
    hulls = hulls_of(load_robot(record.description()))
    count = len(record.joints)
    home = np.full(count, 0.3) if record.home_rad is None else np.array(record.home_rad)
    with open_world("mujoco", hulls.robot.urdf, mesh_hulls(hulls), PhysicsConfig()) as world:
        world.reset_robot(home - 0.05, record.gripper.max_width_m)
        for step in range(240):
            share = min(1.0, step / 120)
            world.robot.command(home + (share - 1.0) * 0.05, np.zeros(count), 0.0)
            world.step()
        joints, _ = world.robot.posture()
    np.testing.assert_allclose(joints, home, atol=2e-3)


def test_mujoco_has_no_soft_bodies_and_says_what_has() -> None:
    with cell("mujoco") as world, pytest.raises(UsageError, match="--engine pybullet"):
        world.soft_bodies()


def test_an_engine_that_is_not_installed_is_named_with_its_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(util, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"robot-gst\[mujoco\]"):
        open_world("mujoco", URDF, {}, PhysicsConfig())
    with pytest.raises(MissingDependencyError, match="--engine mujoco needs it"):
        ReplayConfig(engine="mujoco")
    require_engine("pybullet")


def test_what_a_world_before_was_told_changes_nothing(urdf: str) -> None:
    """Clients are used again: settings, bodies and constraints of one world end with it."""
    while engine._IDLE:
        engine._IDLE.pop().disconnect()
    first = dropped("pybullet")
    odd = PhysicsConfig(rate_hz=480, solver_iterations=7, solver_residual=1e-2, gravity_m_s2=1.0)
    with World(urdf, {}, odd) as world:
        client = world.client
        client.setPhysicsEngineParameter(
            enableConeFriction=0,
            erp=0.9,
            contactERP=0.9,
            frictionERP=0.9,
            numSubSteps=3,
            reportSolverAnalytics=1,
        )
        world.add_free("left", CUBE, 0.05, at(0.5, 0.0, 0.3))
        for _ in range(20):
            world.step()
    with World(urdf, {}, PhysicsConfig()) as world:
        assert world.client == client, "this is about one client"
    assert dropped("pybullet") == first


def test_two_worlds_at_once_are_apart(urdf: str) -> None:
    with World(urdf, {}, PhysicsConfig()) as one, World(urdf, {}, PhysicsConfig()) as other:
        assert one.client != other.client
        one.add_free("cube", CUBE, 0.05, at(0.5, 0.0, 0.3))
        assert not other.free_ids
    assert len(engine._IDLE) == 1


def test_orders_given_once_do_what_repeated_ones_do(monkeypatch: pytest.MonkeyPatch) -> None:
    once = dropped("pybullet")
    command = Arm.command

    def again(self: Arm, joints: np.ndarray, velocity: np.ndarray, width_m: float) -> None:
        self._arm_order = self._finger_order = None
        command(self, joints, velocity, width_m)

    monkeypatch.setattr(Arm, "command", again)
    assert dropped("pybullet") == once


def test_a_link_may_be_called_what_no_file_can_be(urdf: str, tmp_path: Path) -> None:
    other = urdf.replace('"forearm_link"', '"left/forearm_link"')
    assert other != urdf
    path = write_description(other, {"left/forearm_link": [box_corners(CUBE)]}, tmp_path)
    assert "left/forearm_link" in path.read_text()
    assert len(list(tmp_path.glob("*.obj"))) == 1


@pytest.mark.parametrize("seed", range(3))
def test_a_wall_reaches_as_far_as_its_pose_says(urdf: str, seed: int) -> None:
    """Rays along the box's axes meet its faces at half of its extents: asked of the engine."""
    rng = np.random.default_rng(seed)
    extents = np.array([0.1, 0.2, 0.4])
    T = se3.transform_from(rng.normal(size=4), np.array([2.0, 2.0, 2.0]))
    with World(urdf, {}, PhysicsConfig()) as world:
        world.add_static([(np.array([0.05, 0.0, 0.0]), extents)], T)
        for axis in range(3):
            centre = np.array([0.05, 0.0, 0.0])
            start = centre + np.eye(3)[axis]
            ends = (se3.apply(T, point).tolist() for point in (start, centre))
            (hit,) = world.client.rayTest(*ends)
            assert hit[2] == pytest.approx(1.0 - extents[axis] / 2, abs=1e-3)
