"""Laws of clearance, pairs looked at nearest first, shapes that can be worked out by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scripted_plans import joints_over

from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.plan import Stage
from bridge.task.task_file import load_task
from twin.replay.clearance.bodies import (
    TABLE,
    distance_to_planes_m,
    placed_panels,
    placement_of,
    planes_of,
)
from twin.replay.clearance.monitor import (
    ClearanceMonitor,
    State,
    active_stage,
    allowed_pairs,
    object_travel_m,
)
from twin.replay.clearance.surroundings import Pair, Surroundings
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls, hulls_of, signed_distance
from twin.robot.model import load_robot

WIDTH_M = 0.08


def monitor_of(script: SimpleNamespace, scene: ReplayScene, **stage: object) -> ClearanceMonitor:
    plan = script.plan(scene)
    stages = tuple(replace(item, **stage) for item in plan.stages)
    hulls = hulls_of(load_robot(scene.urdf))
    return ClearanceMonitor(scene, replace(plan, stages=stages), hulls, ReplayConfig())


def test_the_distance_to_the_table_is_the_height_of_the_tips(script: SimpleNamespace) -> None:
    scene = script.scene()
    monitor = monitor_of(script, scene)
    for height in (0.035, 0.02, 0.0):  # higher up, the upper arm is the closest: 30 mm
        joints = joints_over(scene, 0.62, -0.1, height)
        assert monitor.measure(0, joints, WIDTH_M, {}) == pytest.approx(height - 0.01, abs=1e-6)


def test_the_smallest_clearance_is_kept_with_when_and_between_what(script: SimpleNamespace) -> None:
    scene = script.scene()
    monitor = monitor_of(script, scene)
    assert monitor.nearest() is None
    heights = {0: 0.035, 1: 0.02, 2: 0.03}
    found = [
        monitor.measure(t_ns, joints_over(scene, 0.62, -0.1, height), WIDTH_M, {})
        for t_ns, height in heights.items()
    ]
    nearest = monitor.nearest() or {}
    assert (nearest["t_ns"], nearest["distance_m"]) == (1, min(found))
    assert nearest["bodies"][1] == "table"


def test_the_margin_decides_between_close_and_too_close(script: SimpleNamespace) -> None:
    scene = script.scene()
    for tips_m, causes in ((0.0025, []), (0.0015, ["too_close"]), (-0.001, ["collision"])):
        monitor = monitor_of(script, scene)
        monitor.measure(0, joints_over(scene, 0.62, -0.1, 0.01 + tips_m), WIDTH_M, {})
        assert [failure.cause for failure in monitor.failures] == causes


def test_the_first_failure_keeps_its_time_and_both_bodies(script: SimpleNamespace) -> None:
    scene = script.scene()
    monitor = monitor_of(script, scene)
    for t_ns, height in ((0, 0.1), (1, 0.005), (2, 0.0)):
        monitor.measure(t_ns, joints_over(scene, 0.62, -0.1, height), WIDTH_M, {})
    collision = next(f for f in monitor.failures if f.cause == "collision")
    assert collision.t_ns == 1
    assert collision.bodies[1] == "table"
    contact = next(c for c in monitor.contacts() if c.bodies[0] == collision.bodies[0])
    assert (contact.start_ns, contact.end_ns, contact.allowed) == (1, 2, False)
    assert contact.min_distance_m == pytest.approx(-0.01, abs=1e-6)


def test_an_allowed_contact_neither_fails_nor_lowers_the_clearance(script: SimpleNamespace) -> None:
    scene = script.scene()
    joints = joints_over(scene, 0.62, -0.1, 0.009)
    allowed = monitor_of(script, scene, allowed_contacts=(("gripper", "table"),))
    assert allowed.measure(0, joints, WIDTH_M, {}) > 0.02
    assert not allowed.failures
    assert allowed.contacts()[0].allowed


def test_an_allowed_contact_is_no_leave_to_go_through(script: SimpleNamespace) -> None:
    scene = script.scene()
    joints = joints_over(scene, 0.62, -0.1, -0.01)
    monitor = monitor_of(script, scene, allowed_contacts=(("gripper", "table"),))
    monitor.measure(0, joints, WIDTH_M, {})
    assert [failure.cause for failure in monitor.failures] == ["deep_contact"]


def test_an_object_at_rest_where_it_started_is_nobodys_collision(script: SimpleNamespace) -> None:
    """The cube lies on the table; only once it was moved does its table contact count."""
    scene = script.scene()
    joints = joints_over(scene, 0.4, 0.0, 0.3)
    monitor = monitor_of(script, scene, allowed_contacts=())
    start = scene.Ts_base_object["cube"]
    monitor.measure(0, joints, WIDTH_M, {"cube": start})
    assert not monitor.failures
    pushed = start.copy()
    pushed[0, 3] += 0.05
    monitor.measure(1, joints, WIDTH_M, {"cube": pushed})
    assert [failure.bodies for failure in monitor.failures] == [("cube", "table")]


def test_the_stage_that_has_begun_last_is_active(script: SimpleNamespace) -> None:
    stages = script.plan(script.scene()).stages
    end = stages[0].t_end_ns
    assert active_stage(stages, 0) is stages[0]
    assert active_stage(stages, end - 1) is stages[0]
    assert active_stage(stages, end) is stages[1]
    assert active_stage(stages, 10**12) is stages[1]
    assert active_stage((), 0) is None


def test_a_higher_table_is_closer_by_its_height(script: SimpleNamespace) -> None:
    scene = replace(script.scene(), table_height_m=0.015)
    joints = joints_over(scene, 0.62, -0.1, 0.03)
    assert monitor_of(script, scene).measure(0, joints, WIDTH_M, {}) == pytest.approx(
        0.005, abs=1e-6
    )


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


@pytest.fixture(scope="module")
def hulls(script: SimpleNamespace) -> RobotHulls:
    return hulls_of(load_robot(script.scene().urdf))


def every_distance(
    scene: ReplayScene, around: Surroundings, hulls: RobotHulls, poses: dict[str, np.ndarray]
) -> dict[tuple[str, str], float]:
    """The smallest distance of each pair of bodies, all pieces measured, by shapes alone."""
    found: dict[tuple[str, str], float] = {}

    def note(body: str, other: str, distance: float) -> None:
        found[body, other] = min(found.get((body, other), np.inf), distance)

    cubes = {name: (around.objects[name].shape, placement_of(T)) for name, T in poses.items()}
    placements = [hulls.placement(index) for index in range(len(hulls.hulls))]
    for link, placed in zip(around.links, placements, strict=True):
        for name, cube in cubes.items():
            note(link.body, name, signed_distance(link.shape, placed, *cube))
    movers = [
        *((link.body, link.shape, p) for link, p in zip(around.links, placements)),  # noqa: B905
        *((name, *cube) for name, cube in cubes.items()),
    ]
    for solid, _, T in around.static:
        for body, shape, placed in movers:
            if solid.body == TABLE and body in ("base_link", "shoulder_link"):
                continue
            distance = signed_distance(shape, placed, solid.shape, placement_of(T))
            note(body, solid.body, distance)
    return found


def test_near_pairs_are_those_of_measuring_every_pair(
    script: SimpleNamespace, hulls: RobotHulls
) -> None:
    scene = script.scene()
    around = Surroundings(scene, hulls, 0.002)
    near_m, rng, num_near = 0.03, np.random.default_rng(6), 0
    for _ in range(30):
        x, y, z = rng.uniform([0.45, -0.2, 0.02], [0.6, 0.25, 0.15])
        hulls.place(joints_over(scene, x, y, z), WIDTH_M)
        q = np.append(1.0, rng.uniform(-0.5, 0.5, 3))
        T = se3.transform_from(q / np.linalg.norm(q), np.array([x + 0.03, y, z]))
        distances, cut_m = around.measure(
            {"cube": T}, ["cube"], near_m=near_m, counts=lambda body, other: other != "cube"
        )
        measured: dict[tuple[str, str], float] = {}
        pair: Pair
        for pair, distance in distances.items():
            bodies = pair[0], pair[2]
            measured[bodies] = min(measured.get(bodies, np.inf), distance)
        for bodies, distance in every_distance(scene, around, hulls, {"cube": T}).items():
            if distance <= min(cut_m, near_m):
                assert measured[bodies] == distance
                num_near += 1
            else:
                assert measured.get(bodies, np.inf) >= cut_m or measured[bodies] == distance
        counted = [d for (_, other), d in measured.items() if other != "cube"]
        assert cut_m == max(near_m, min(counted))
    assert num_near > 60


def test_the_boxes_of_a_basket_hold_its_rim_its_corners_and_its_handles() -> None:
    """Otherwise the audit, which has the mesh, finds less distance than the clearance said."""
    basket = load_task("sloth_over_rim").objects["basket"]
    vertices = object_mesh(basket).vertices_m
    away = np.full(len(vertices), np.inf)
    for T, extents in placed_panels(basket, np.eye(4)):
        q = np.abs(se3.apply(se3.invert(T), vertices)) - extents / 2
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        away = np.minimum(away, outside + np.minimum(q.max(axis=1), 0.0))
    assert away.max() < 5e-4
    assert away.min() > -0.01
