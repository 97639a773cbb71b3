"""Laws of clearance: how far an object travels, what a contact keeps, what stays allowed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scripted_plans import joints_over

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.task.plan import Stage
from twin.replay.clearance.bodies import distance_to_planes_m, planes_of
from twin.replay.clearance.monitor import ClearanceMonitor, State, allowed_pairs, object_travel_m
from twin.replay.config import ReplayConfig
from twin.robot.collision import hulls_of
from twin.robot.model import load_robot

JOINTS = np.zeros(6)


def with_cube(T: np.ndarray) -> State:
    return State(t_ns=0, joints_rad=JOINTS, width_m=0.0, Ts_base_object={"cube": T})


@given(st.integers(0, 10**6), st.floats(1e-3, 1.0), st.floats(0.01, 0.2))
def test_no_point_of_an_object_travels_farther_than_is_said(
    seed: int, size: float, radius_m: float
) -> None:
    """All states on the way: a straight shift and an even turn about the object's origin."""
    rng = np.random.default_rng(seed)
    T = se3.transform_from(rng.normal(size=4), rng.normal(size=3))
    shift, turn = 0.1 * size * rng.normal(size=3), size * rng.normal(size=3)
    points = rng.normal(size=(40, 3))
    points *= radius_m / np.linalg.norm(points, axis=1)[:, None]

    def at(share: float) -> np.ndarray:
        moved = T.copy()
        moved[:3, :3] = se3.rotation_from_vector(share * turn) @ T[:3, :3]
        moved[:3, 3] += share * shift
        return moved

    way = np.array([se3.apply(at(share), points) for share in np.linspace(0, 1, 50)])
    travelled = np.linalg.norm(np.diff(way, axis=0), axis=2).sum(axis=0)
    if np.linalg.norm(turn) < 3.0:  # beyond half a turn the shorter way round is another one
        assert travelled.max() <= object_travel_m(with_cube(T), with_cube(at(1)), "cube", radius_m)


def test_a_contact_keeps_the_smallest_distance_of_its_time(script: SimpleNamespace) -> None:
    scene = script.scene()
    monitor = ClearanceMonitor(
        scene, script.plan(scene), hulls_of(load_robot(scene.urdf)), ReplayConfig()
    )
    for t_ns, tips_m in enumerate((0.0015, 0.0005, -0.001, 0.001, 0.05)):
        monitor.measure(t_ns, joints_over(scene, 0.62, -0.1, 0.01 + tips_m), 0.08, {})
    contacts = [contact for contact in monitor.contacts() if "table" in contact.bodies]
    assert contacts
    deepest = min(contact.min_distance_m for contact in contacts)
    assert deepest == pytest.approx(-0.001, abs=1e-5)
    for contact in contacts:
        assert contact.min_distance_m <= 0.0005, "it came nearer after the first instant"


@pytest.mark.parametrize("releases", [True, False])
def test_what_was_let_go_of_may_stay_where_it_was_put_and_the_gripper_may_not(
    releases: bool,
) -> None:
    put = Stage(
        id="put",
        text="",
        t_start_ns=0,
        release="cube" if releases else None,
        allowed_contacts=(("cube", "box"), ("gripper", "cube")),
    )
    leave = replace(put, id="leave", t_start_ns=10, release=None, allowed_contacts=())
    lies = frozenset(("cube", "box"))
    assert allowed_pairs((put, leave), 5) == {lies, frozenset(("gripper", "cube"))}
    assert allowed_pairs((put, leave), 15) == ({lies} if releases else set())


def test_corners_of_a_placed_hull_lie_on_it_and_its_middle_inside() -> None:
    """Whatever way it is turned; and a point moved outwards is as far away as it was moved."""
    rng = np.random.default_rng(4)
    hulls = hulls_of(load_robot(ROBOT.urdf_text()))
    for hull, planes in zip(hulls.hulls, planes_of(hulls), strict=True):
        R = se3.rotation_from_quaternion(rng.normal(size=4))
        t = rng.normal(size=3)
        for corner in hull.points_m[::7]:
            found = distance_to_planes_m(planes, (R @ corner + t)[None], R, t)
            assert found == pytest.approx(0.0, abs=1e-6)
        middle = hull.points_m.mean(axis=0)
        assert distance_to_planes_m(planes, (R @ middle + t)[None], R, t) < 0
        normal, offset = planes[0, :3], planes[0, 3]
        face = middle - (normal @ middle + offset) * normal  # above the face, seen from the middle
        outside = R @ (face + 0.05 * normal) + t
        assert distance_to_planes_m(planes, outside[None], R, t) >= 0.05 - 1e-9


@pytest.mark.parametrize(
    ("gap_m", "causes"), [(0.001, []), (0.0, []), (-0.006, ["pre_grasp_penetration"])]
)
def test_before_the_grasp_fingers_beside_an_object_are_not_in_it(
    script: SimpleNamespace, gap_m: float, causes: list[str]
) -> None:
    """On both sides of a cube of 40 mm, a millimetre away from it, or six deep."""
    scene = script.scene()
    T = se3.transform_from(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, -0.15, 0.02]))
    scene = replace(scene, Ts_base_object={**scene.Ts_base_object, "cube": T})
    monitor = ClearanceMonitor(
        scene, script.plan(scene), hulls_of(load_robot(scene.urdf)), ReplayConfig()
    )
    monitor.check_pre_grasp(0, joints_over(scene, 0.5, -0.15, 0.02), 0.04 + 2 * gap_m)
    assert [failure.cause for failure in monitor.failures] == causes
