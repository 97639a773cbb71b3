"""Laws of the robot model: two engines agree, postures, and hulls that are never too small."""

import math
import re
from dataclasses import replace
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.robots.robot import Gripper, read_robot
from twin.robot import inverse
from twin.robot.collision import RobotHulls, hulls_of, signed_distance
from twin.robot.inverse import UrInverse, solve_ik
from twin.robot.model import RobotDescriptionError, RobotModel, load_robot
from twin.robot.posture import PostureTrack, width_track

HOME = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.3])


@pytest.mark.parity
def test_pinocchio_and_pybullet_agree_on_forward_kinematics(
    robot: RobotModel, tmp_path: Path
) -> None:
    from twin.physics.arm import write_description
    from twin.physics.engine import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(
            str(write_description(robot.urdf, {}, tmp_path)), physicsClientId=client
        )
        infos = [
            pybullet.getJointInfo(body, index, physicsClientId=client)
            for index in range(pybullet.getNumJoints(body, physicsClientId=client))
        ]
        joints = {info[1].decode(): index for index, info in enumerate(infos)}
        links = {info[12].decode(): index for index, info in enumerate(infos)}
        rng = np.random.default_rng(0)
        for _ in range(50):
            q = rng.uniform(-np.pi, np.pi, 6)
            for name, value in zip(ARM_JOINTS, q, strict=True):
                pybullet.resetJointState(body, joints[name], value, physicsClientId=client)
            for link in ("tcp", "forearm_link", "wrist_3_link"):
                state = pybullet.getLinkState(
                    body, links[link], computeForwardKinematics=1, physicsClientId=client
                )
                T = robot.T_base_link(link, q)
                np.testing.assert_allclose(state[4], T[:3, 3], atol=1e-6)
                q_xyzw = np.array(state[5])
                R = se3.rotation_from_quaternion(q_xyzw[[3, 0, 1, 2]])
                np.testing.assert_allclose(R, T[:3, :3], atol=2e-6)
    finally:
        pybullet.disconnect(physicsClientId=client)


def test_inverse_kinematics_undoes_forward_kinematics(robot: RobotModel) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = rng.uniform(-2.5, 2.5, 6)
        T = robot.T_base_tcp(q)
        near = solve_ik(robot, T, warm_start_rad=q + rng.normal(0, 0.02, 6))
        cold = solve_ik(robot, T)
        for solution in (near, cold):
            assert solution.reached
            np.testing.assert_allclose(robot.T_base_tcp(solution.joints_rad), T, atol=1e-6)
            assert np.all(solution.joints_rad >= robot.lower_rad)
            assert np.all(solution.joints_rad <= robot.upper_rad)
        assert np.abs(near.joints_rad - q).max() < 0.3


def test_a_pose_out_of_reach_is_not_reached_and_says_by_how_much(robot: RobotModel) -> None:
    T = robot.T_base_tcp(HOME)
    T[:3, 3] = (2.0, 0.0, 0.3)
    solution = solve_ik(robot, T, restarts=2)
    assert not solution.reached
    assert solution.position_error_m > 0.5


def test_an_unknown_frame_lists_the_frames_there_are(robot: RobotModel) -> None:
    with pytest.raises(RobotDescriptionError, match="tcp"):
        robot.T_base_link("thumb", HOME)


POSTURE = np.array([0.3, -1.3, 1.5, -1.6, -1.4, 0.4])


@pytest.mark.parametrize(
    ("tolerance_m", "tolerance_rad", "reached"),
    [(0.1, math.pi, True), (0.1, 1e-9, False), (1e-9, math.pi, False), (1e-9, 1e-9, False)],
)
def test_a_pose_is_reached_within_both_tolerances_only(
    robot: RobotModel,
    tolerance_m: float,
    tolerance_rad: float,
    reached: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two iterations come near, and no nearer."""
    monkeypatch.setattr(inverse, "POSITION_TOLERANCE_M", tolerance_m)
    monkeypatch.setattr(inverse, "ROTATION_TOLERANCE_RAD", tolerance_rad)
    monkeypatch.setattr(inverse, "MAX_ITERATIONS", 2)
    T = robot.T_base_tcp(POSTURE)
    found = solve_ik(robot, T, warm_start_rad=POSTURE + 0.1, restarts=0)
    assert 1e-9 < found.position_error_m < 0.1
    assert 1e-9 < found.rotation_error_rad < math.pi
    assert found.reached is reached


@given(st.lists(st.floats(-2 * math.pi, 0.0), min_size=6, max_size=6))
def test_limits_a_whole_turn_apart_lose_no_answer_wherever_they_are(lower: list[float]) -> None:
    robot = load_robot(ROBOT.urdf_text())
    wide = UrInverse.for_robot(robot)
    assert wide is not None
    low = np.array(lower)
    turn = UrInverse(geometry=wide.geometry, lower_rad=low, upper_rad=low + 2 * math.pi)
    Ts = robot.Ts_base_tcp(np.array([POSTURE, -POSTURE + 0.3]))
    joints, valid, _ = turn.solve(Ts)
    assert np.array_equal(valid, wide.solve(Ts)[1])
    assert np.all(joints[valid] >= low - 1e-6)
    assert np.all(joints[valid] <= low + 2 * math.pi + 1e-6)


@pytest.mark.parametrize("joint", range(6))
def test_one_joint_that_moves_is_enough_to_be_moving(joint: int) -> None:
    stamps = np.arange(0, 2_000_000_000, 8_000_000, dtype=np.int64)
    position = np.tile(POSTURE, (len(stamps), 1))
    moving = stamps > 1_000_000_000
    position[moving, joint] += 0.2 * (stamps[moving] - 1_000_000_000) * 1e-9
    arm = JointTrack(names=ARM_JOINTS, stamps_ns=stamps, position=position)
    track = PostureTrack(urdf="", arm=arm, widths=None)
    assert track.is_stationary(500_000_000)
    assert not track.is_stationary(1_500_000_000)


def test_the_width_follows_from_a_finger_among_the_joint_states(tmp_path: Path) -> None:
    """A Panda's driver sends its fingers with the arm, and no gripper state."""
    robot = read_robot("panda")
    path = tmp_path / "trial_0001.mcap"
    names = (*robot.joints, "panda_finger_joint1")
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial"))
        for index, half_m in enumerate((0.04, 0.01)):
            sample = at_positions(index * 10**9, names, np.array([0.0] * 7 + [half_m]))
            writer.write(
                "/cell/joint_states",
                sample.to_cdr(),
                type_name=schema.JOINT_STATE,
                log_time_ns=sample.stamp_ns,
            )
    episode = Episode.open(path)
    widths = width_track(episode, robot)
    assert widths.names == ("gripper_width",)
    np.testing.assert_allclose(widths.position[:, 0], [0.08, 0.02])
    with pytest.raises(EpisodeError):
        width_track(episode, ROBOT)
    fixed = replace(robot, gripper=Gripper())
    assert width_track(episode, fixed).position.tolist() == [[0.0], [0.0]]


UPRIGHT = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])


@pytest.fixture(scope="module")
def hulls() -> RobotHulls:
    return hulls_of(load_robot(ROBOT.urdf_text()))


@pytest.mark.parity
def test_no_hull_is_further_from_a_box_than_its_mesh(hulls: RobotHulls) -> None:
    """Pins the trap of ``buildConvexRepresentation``: up to 95 mm too far, the unsafe side."""
    robot = hulls.robot
    geometry = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.COLLISION)
    box = coal.Box(0.1, 0.2, 0.05)
    rng = np.random.default_rng(2)
    checked = 0
    for hull, item in zip(hulls.hulls, geometry.geometryObjects, strict=True):
        T_link = robot.model.frames[item.parentFrame].placement
        T_link_shape = T_link.inverse() * item.placement
        T_mesh = coal.Transform3s(T_link_shape.rotation, T_link_shape.translation)
        for _ in range(20):
            direction = rng.normal(size=3)
            centre = direction / np.linalg.norm(direction) * rng.uniform(0.1, 0.6)
            T_box = coal.Transform3s(pin.SE3.Random().rotation, centre)
            to_hull = signed_distance(hull.shape, coal.Transform3s(), box, T_box)
            to_mesh = signed_distance(item.geometry, T_mesh, box, T_box)
            if to_mesh > 0:
                assert to_hull <= to_mesh + 1e-6, hull.link
                checked += 1
    assert checked > 150


def test_hulls_are_placed_where_the_kinematics_of_their_links_says(hulls: RobotHulls) -> None:
    """Two postures: what was read once must follow the arm."""
    rng = np.random.default_rng(3)
    for _ in range(2):
        joints, width = rng.uniform(-3.0, 3.0, 6), float(rng.uniform(0.0, 0.08))
        hulls.place(joints, width)
        placed = zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True)
        for index, (hull, R, t) in enumerate(placed):
            placement = hulls.placement(index)
            T = hulls.robot.T_base_link(hull.link, joints, width)
            np.testing.assert_array_equal(R, T[:3, :3])
            np.testing.assert_array_equal(t, T[:3, 3])
            np.testing.assert_array_equal(placement.getRotation(), T[:3, :3])
            np.testing.assert_array_equal(placement.getTranslation(), T[:3, 3])
            hulls.place(joints, width)


def test_the_home_posture_is_free_of_self_collision(hulls: RobotHulls) -> None:
    hulls.place(UPRIGHT, 0.08)
    assert hulls.self_distance()[0] > 0.005


def test_a_folded_arm_collides_with_itself_and_names_both_links(hulls: RobotHulls) -> None:
    hulls.place(np.array([0.0, -1.57, 3.0, 0.0, -1.57, 0.0]), 0.08)
    distance_m, links = hulls.self_distance()
    assert distance_m < 0
    assert "upper_arm_link" in links or "shoulder_link" in links


def test_links_that_can_meet_are_checked_and_neighbours_are_not(hulls: RobotHulls) -> None:
    names = {frozenset((hulls.hulls[a].link, hulls.hulls[b].link)) for a, b in hulls.pairs}
    assert frozenset(("base_link", "gripper_left_finger")) in names
    assert frozenset(("upper_arm_link", "wrist_1_link")) in names
    assert frozenset(("upper_arm_link", "forearm_link")) not in names
    assert frozenset(("gripper_left_finger", "gripper_right_finger")) not in names


def test_penetration_depth_of_boxes_is_the_overlap() -> None:
    box = coal.Box(0.1, 0.1, 0.1)
    T = coal.Transform3s(np.eye(3), np.array([0.08, 0.0, 0.0]))
    assert signed_distance(box, coal.Transform3s(), box, T) == pytest.approx(-0.02, abs=1e-6)


def test_a_collision_mesh_that_is_no_mesh_is_named(tmp_path: Path) -> None:
    mesh = tmp_path / "broken.stl"
    mesh.write_bytes(b"not a mesh")
    urdf = ROBOT.urdf_text()
    first = re.search(r'<collision>.*?filename="([^"]+)"', urdf, flags=re.DOTALL)
    assert first is not None
    broken = urdf.replace(first[1], str(mesh))
    with pytest.raises(RobotDescriptionError, match="cannot be read"):
        RobotHulls(load_robot(broken))


def test_every_mesh_vertex_lies_in_its_hull(hulls: RobotHulls) -> None:
    point = coal.Sphere(1e-6)
    for hull in hulls.hulls:
        for vertex in hull.points_m[::7]:
            T = coal.Transform3s(np.eye(3), vertex)
            assert signed_distance(hull.shape, coal.Transform3s(), point, T) < 1e-5, hull.link
