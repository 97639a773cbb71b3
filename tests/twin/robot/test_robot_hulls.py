"""Hulls must never stand further from an obstacle than the mesh they replace."""

import re
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest

from bridge.robots.default import ROBOT
from twin.robot.collision import RobotHulls, hulls_of, signed_distance
from twin.robot.model import RobotDescriptionError, load_robot

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])


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
    hulls.place(HOME, 0.08)
    assert hulls.self_distance().distance_m > 0.005


def test_a_folded_arm_collides_with_itself_and_names_both_links(hulls: RobotHulls) -> None:
    hulls.place(np.array([0.0, -1.57, 3.0, 0.0, -1.57, 0.0]), 0.08)
    closest = hulls.self_distance()
    assert closest.distance_m < 0
    assert "upper_arm_link" in closest.links or "shoulder_link" in closest.links


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
