"""Clearance to what the scene shows: signed, named, masked, soft, and nothing missed in between."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scripted_plans import joints_over

from bridge.geometry import se3
from bridge.task.task_file import load_task
from twin.replay.clearance.bodies import (
    SCENE,
    distance_to_planes_m,
    distances_to_boxes_m,
    own_links_touch,
    planes_of,
)
from twin.replay.clearance.bounding_spheres import bounding_spheres_of, grid_distances_m
from twin.replay.clearance.monitor import ClearanceMonitor, Reach
from twin.replay.clearance.static_obstacles import unmodelled_obstacles
from twin.replay.clearance.surroundings import Surroundings, posture_clearance
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls, hulls_of
from twin.robot.inverse import solve_ik
from twin.robot.model import load_robot
from twin.scene.shape.sdf import SdfGrid, distances_of_solid
from twin.scene.shape.static import StaticSdf

VOXEL_M = 0.008
WIDTH_M = 0.08
Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Centre and extents [m]."""


@cache
def static_of(*boxes: Box, table_m: float | None = 0.0, left_m: float = 0.3) -> StaticSdf:
    """A scene of boxes, as a rebuilt scene would hold it; the table's top is a face of voxels."""
    counts = (60, 100, 50)
    origin = np.array([left_m, -0.5, -0.04]) + VOXEL_M / 2
    x, y, z = (origin[a] + VOXEL_M * np.arange(n) for a, n in enumerate(counts))
    solid = np.zeros(counts, dtype=bool)
    if table_m is not None:
        solid[:, :, z < table_m] = True
    for centre, extents in boxes:
        inside = [
            np.abs(axis - c) < e / 2 for axis, c, e in zip((x, y, z), centre, extents, strict=True)
        ]
        solid |= inside[0][:, None, None] & inside[1][None, :, None] & inside[2][None, None, :]
    grid = SdfGrid(
        values_m=distances_of_solid(solid, VOXEL_M), origin_m=origin, voxel_m=VOXEL_M, closed=False
    )
    return StaticSdf(conservative=grid, observed=grid)


POST: Box = ((0.62, -0.3, 0.16), (0.048, 0.048, 0.32))


def monitor_of(script: SimpleNamespace, scene: ReplayScene, **stage: object) -> ClearanceMonitor:
    plan = script.plan(script.scene())
    stages = tuple(replace(item, **stage) for item in plan.stages)
    hulls = hulls_of(load_robot(scene.urdf))
    return ClearanceMonitor(scene, replace(plan, stages=stages), hulls, ReplayConfig())


@pytest.fixture(scope="module")
def hulls(script: SimpleNamespace) -> RobotHulls:
    return hulls_of(load_robot(script.scene().urdf))


def test_a_post_that_only_the_grid_shows_is_measured_and_named(script: SimpleNamespace) -> None:
    """The gripper's base reaches 55 mm beside the tool."""
    scene = replace(script.scene(), static_sdf=static_of(POST))
    face_m = -0.3 + 0.024
    joints = joints_over(scene, 0.62, face_m + 0.055 + 0.02, 0.1)
    monitor = monitor_of(script, scene)
    distance = monitor.measure(0, joints, WIDTH_M, {})
    assert distance == pytest.approx(0.02, abs=0.6 * VOXEL_M)
    assert distance <= 0.02
    assert not monitor.failures
    nearest = monitor.nearest() or {}
    assert (nearest["bodies"][1], nearest["distance_m"]) == (SCENE, distance)
    inside = monitor_of(script, scene)
    assert inside.measure(0, joints_over(scene, 0.62, face_m + 0.04, 0.1), WIDTH_M, {}) < -0.005
    assert inside.failures[0].cause == "collision"
    assert inside.failures[0].bodies[1] == SCENE
    assert "gripper" in inside.failures[0].bodies[0]


def test_an_allowed_touch_of_the_table_is_no_touch_of_the_scene(script: SimpleNamespace) -> None:
    """The grid shows the table as well; only the named one counts."""
    scene = replace(script.scene(), static_sdf=static_of(POST))
    joints = joints_over(scene, 0.45, 0.0, 0.008)
    monitor = monitor_of(script, scene, allowed_contacts=(("gripper", "table"),))
    monitor.measure(0, joints, WIDTH_M, {})
    assert not monitor.failures
    assert {contact.bodies[1] for contact in monitor.contacts()} == {"table"}


def test_a_container_that_the_grid_shows_as_well_counts_once(script: SimpleNamespace) -> None:
    scene = script.scene()
    T = scene.Ts_base_object["box"]
    panels = scene.task.objects["box"].panels()
    seen = [(tuple(se3.apply(T, c).tolist()), tuple((e + 0.004).tolist())) for c, e in panels]
    with_grid = replace(scene, static_sdf=static_of(*seen, POST))
    x, y = T[:2, 3]
    joints = joints_over(scene, float(x), float(y), 0.03)
    allowed = (("gripper", "box"),)
    monitor = monitor_of(script, with_grid, allowed_contacts=allowed)
    with_distance = monitor.measure(0, joints, 0.0, {})
    without = monitor_of(script, scene, allowed_contacts=allowed).measure(0, joints, 0.0, {})
    assert not [f for f in monitor.failures if f.bodies[1] == SCENE]
    assert with_distance == pytest.approx(without, abs=1e-9) or with_distance > 0.05


def test_the_robots_own_foot_is_not_in_its_way(script: SimpleNamespace) -> None:
    foot: Box = ((0.0, 0.0, 0.08), (0.14, 0.14, 0.16))
    scene = replace(script.scene(), static_sdf=static_of(foot, left_m=-0.25))
    monitor = monitor_of(script, scene)
    monitor.measure(0, joints_over(scene, 0.4, 0.0, 0.3), WIDTH_M, {})
    assert not monitor.failures


def test_taking_a_container_out_leaves_distances_that_are_never_too_large() -> None:
    """Against distances made anew everywhere, the slow way."""
    box: Box = ((0.3, 0.1, 0.05), (0.16, 0.16, 0.1))
    wall: Box = ((0.6, 0.1, 0.2), (0.04, 0.6, 0.4))
    T = np.eye(4)
    T[:3, 3] = box[0]
    local = unmodelled_obstacles(
        static_of(box, wall, table_m=None), -0.1, None, [(T, np.array(box[1]))]
    )
    full = unmodelled_obstacles(static_of(wall, table_m=None), -0.1, None, [])
    assert local is not None
    assert full is not None
    close = np.abs(full.values_m) < 0.1
    assert np.all(local.values_m <= full.values_m + 1e-5)
    assert np.abs(local.values_m - full.values_m)[close & (full.values_m > 0)].max() < 2 * VOXEL_M


def test_no_point_of_a_hull_is_farther_from_its_tree_than_is_subtracted(hulls: RobotHulls) -> None:
    from scipy.spatial import ConvexHull, cKDTree

    rng = np.random.default_rng(5)
    for hull in hulls.hulls[3:]:
        tree = bounding_spheres_of(hull.points_m, 0.004)
        corners = hull.points_m[ConvexHull(hull.points_m).simplices]
        weights = rng.dirichlet(np.ones(3), size=len(corners))
        points = np.einsum("nk,nkj->nj", weights, corners)
        finest = tree.points_m[tree.children[:, 0] == tree.children[:, 1]]
        assert cKDTree(finest).query(points)[0].max() <= tree.cover_m + 1e-9


def test_everything_below_a_point_of_a_tree_is_within_its_radius() -> None:
    tree = bounding_spheres_of(np.random.default_rng(6).uniform(-0.05, 0.05, (30, 3)))
    parent = np.full(len(tree.points_m), -1)
    for index, (begin, end) in enumerate(tree.children):
        assert np.all(parent[begin:end] == -1)
        parent[begin:end] = index
    assert np.flatnonzero(parent == -1).tolist() == list(range(tree.num_roots))
    for index in np.flatnonzero(tree.children[:, 0] == tree.children[:, 1]):
        above = parent[index]
        while above >= 0:
            away = np.linalg.norm(tree.points_m[index] - tree.points_m[above])
            assert away + tree.cover_m <= tree.radius_m[above] + 1e-9
            above = parent[above]


def test_reach_bounds_how_far_any_point_of_a_link_moves(hulls: RobotHulls) -> None:
    rng = np.random.default_rng(8)
    reach = Reach(hulls)
    for _ in range(30):
        a = rng.uniform(-2, 2, 6)
        b = a + rng.normal(0, 0.05, 6)
        before, after = [], []
        for joints, width, kept in ((a, 0.02, before), (b, 0.06, after)):
            hulls.place(joints, width)
            kept += [
                hull.points_m @ R.T + t
                for hull, R, t in zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True)
            ]
        moved = [np.linalg.norm(q - p, axis=1).max() for p, q in zip(before, after, strict=True)]
        bounds = reach.travel_m(b - a, 0.04)
        assert np.all(np.array(moved) <= bounds + 1e-9)


@pytest.mark.parametrize("static", [None, static_of(POST)])
def test_a_post_passed_between_two_states_is_not_missed(
    script: SimpleNamespace, static: StaticSdf | None
) -> None:
    """2 s apart both states are free, and the gripper went through the post in between.

    Without the grid the post is not known, and nothing is made up.
    """
    scene = replace(script.scene(), static_sdf=static)
    robot = load_robot(scene.urdf)
    monitor = monitor_of(script, scene)
    before = joints_over(scene, 0.62, -0.3 - 0.13, 0.2)
    T = robot.T_base_tcp(before)
    T[1, 3] += 0.26
    after = solve_ik(robot, T, warm_start_rad=before).joints_rad
    assert monitor.measure(0, before, 0.0, {}) > 0.01
    lowest = monitor.measure(2_000_000_000, after, 0.0, {})
    if static is None:
        assert not monitor.failures
        return
    assert lowest < -0.005
    collision = next(f for f in monitor.failures if f.cause == "collision")
    assert 0 < collision.t_ns < 2_000_000_000
    assert collision.bodies[1] == SCENE
    again = monitor_of(script, scene)
    assert again.measure(0, after, 0.0, {}) > 0.01


def test_a_thin_wall_of_the_box_is_not_jumped_over(script: SimpleNamespace) -> None:
    """6 mm of wall, 60 mm of motion."""
    scene = script.scene()
    wall_x = 0.5 + 0.078
    monitor = monitor_of(script, scene, allowed_contacts=())
    robot = load_robot(scene.urdf)
    before = joints_over(scene, wall_x - 0.03, 0.19, 0.045)
    T = robot.T_base_tcp(before)
    T[0, 3] += 0.06
    after = solve_ik(robot, T, warm_start_rad=before).joints_rad
    monitor.measure(0, before, 0.0, {})
    monitor.measure(20_000_000, after, 0.0, {})
    assert any(failure.bodies[1] == "box" for failure in monitor.failures)


def ball(centre: tuple[float, float, float], radius: float = 0.03) -> np.ndarray:
    """Nodes of a soft ball."""
    rng = np.random.default_rng(9)
    points = rng.normal(size=(400, 3))
    return centre + radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def test_a_soft_body_is_measured_by_its_nodes_once_it_has_moved(script: SimpleNamespace) -> None:
    task = load_task("sloth_into_basket")
    toy = task.manipulated[0]
    start = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, -0.15, 0.04]))
    scene = ReplayScene(task=task, Ts_base_object={toy: start}, urdf=script.scene().urdf)
    monitor = monitor_of(script, scene, allowed_contacts=())
    away = joints_over(scene, 0.4, 0.3, 0.35)
    monitor.measure(0, away, WIDTH_M, {}, {toy: ball((0.5, -0.15, 0.03))})
    assert not monitor.failures, "where it lies is nobody's doing"
    monitor.measure(1, away, WIDTH_M, {}, {toy: ball((0.5, -0.10, 0.025))})
    assert monitor.failures[0].bodies == (toy, "table")
    assert monitor.failures[0].cause == "collision"


def test_a_finger_in_a_soft_body_is_as_deep_as_its_nodes_say(
    script: SimpleNamespace, hulls: RobotHulls
) -> None:
    task = load_task("sloth_into_basket")
    toy = task.manipulated[0]
    start = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, -0.15, 0.04]))
    scene = ReplayScene(task=task, Ts_base_object={toy: start}, urdf=script.scene().urdf)
    joints = joints_over(scene, 0.5, -0.15, 0.12)
    T = load_robot(scene.urdf).T_base_tcp(joints)
    monitor = monitor_of(script, scene, allowed_contacts=())
    nodes = ball(tuple((T[:3, 3] + [0.0, 0.0, 0.07]).tolist()))
    assert monitor.measure(0, joints, WIDTH_M, {}, {toy: nodes}) < -0.02
    assert "gripper_base" in {failure.bodies[0] for failure in monitor.failures}
    hulls.place(joints, WIDTH_M)
    index = next(i for i, hull in enumerate(hulls.hulls) if hull.link == "gripper_base")
    lone = np.array([[0.0, 0.0, 0.2]])  # above the box of the gripper's base, in its own frame
    R, t = hulls.rotations[index], hulls.translations[index]
    planes = planes_of(hulls)[index]
    assert distance_to_planes_m(planes, lone @ R.T + t, R, t) == pytest.approx(0.12)


def test_distances_of_points_to_a_box_are_exact() -> None:
    T = se3.transform_from(np.array([0.9, 0.1, 0.2, 0.3]), np.array([0.1, 0.2, 0.3]))
    boxes = [(T, np.array([0.2, 0.1, 0.4])), (np.eye(4), np.full(3, 2.0))]
    for local, expected in (
        ([0.2, 0.0, 0.0], 0.1),
        ([0.13, 0.09, 0.0], 0.05),
        ([0.0, 0.03, 0.0], -0.02),
    ):
        points = se3.apply(T, np.array([local, [5.0, 5.0, 5.0]]))
        found = distances_to_boxes_m(points, boxes)
        assert found[0] == pytest.approx(expected)
        assert found[1] == pytest.approx(np.abs(points[0]).max() - 1.0), "the box at the base"


def test_before_the_grasp_a_toy_is_as_large_as_its_mesh(script: SimpleNamespace) -> None:
    """A finger in an empty corner of the box around it hurts nobody; one in its middle does."""
    task = load_task("sloth_into_basket")
    toy = task.manipulated[0]
    size = task.objects[toy].size_m
    start = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, -0.1, size[2] / 2]))
    scene = ReplayScene(task=task, Ts_base_object={toy: start}, urdf=script.scene().urdf)
    corner = monitor_of(script, scene)
    x, y = 0.5 + size[0] / 2 - 0.002, -0.1 + size[1] / 2 - 0.002
    corner.check_pre_grasp(0, joints_over(scene, x + 0.012, y + 0.012, size[2]), 0.0)
    assert not corner.failures
    middle = monitor_of(script, scene)
    middle.check_pre_grasp(0, joints_over(scene, 0.5, -0.1, size[2] / 2), 0.0)
    assert [failure.cause for failure in middle.failures] == ["pre_grasp_penetration"]


def test_an_object_that_leaps_did_not_fly_through_what_lies_between(
    script: SimpleNamespace,
) -> None:
    """Localised again elsewhere: nobody knows how it came there."""
    scene = script.scene()
    monitor = monitor_of(script, scene, allowed_contacts=(("cube", "table"),))
    joints = joints_over(scene, 0.4, -0.3, 0.35)
    box = scene.Ts_base_object["box"][:3, 3]
    for t_ns, offset in enumerate((-0.13, 0.13)):
        T = np.eye(4)
        T[:3, 3] = box + np.array([offset, 0.0, 0.03])
        monitor.measure(t_ns, joints, WIDTH_M, {"cube": T})
    assert not monitor.failures


def test_a_posture_is_as_clear_as_the_nearest_of_all_its_distances(
    script: SimpleNamespace, hulls: RobotHulls
) -> None:
    """To the last bit, though most pairs are hardly looked at."""
    config, rng = ReplayConfig(), np.random.default_rng(4)
    post: Box = ((0.45, -0.25, 0.3), (0.06, 0.06, 0.6))
    scene = replace(script.scene(), static_sdf=static_of(POST, post))
    gripper = hulls.robot.record.gripper.links
    around, links_touch = Surroundings(scene, hulls, config.eps_col_m), own_links_touch(hulls)
    margin_m = posture_clearance(scene, hulls, config)
    inside = outside = 0
    for joints in hulls.robot.home_rad + rng.uniform(-0.9, 0.9, (80, 6)):
        found = float(margin_m(joints[None])[0])
        hulls.place(joints, hulls.robot.record.gripper.max_width_m)
        if links_touch():
            continue
        distances, _ = around.measure({}, [], near_m=9.0, counts=lambda body, other: True)
        arm = [d for (body, *_), d in distances.items() if body not in gripper]
        assert found == min(arm) - config.eps_col_m
        inside, outside = inside + (min(arm) < 0), outside + (min(arm) > 0.02)
    assert inside > 3
    assert outside > 10


def test_lookups_are_those_of_the_grid_and_beyond_it_never_too_large() -> None:
    rng = np.random.default_rng(4)
    grid = replace(static_of(POST).observed, closed=True)
    points = rng.uniform([-0.6, -0.8, -0.1], [1.0, 0.8, 0.7], (4000, 3))
    found, known = grid_distances_m(grid, points), grid.distance(points)
    end = grid.origin_m + VOXEL_M * (np.array(grid.values_m.shape) - 1)
    held = np.clip(points, grid.origin_m, end)
    alike = (grid.distance(held) > 0) | (held == points).all(axis=1)
    np.testing.assert_allclose(found[alike], known[alike], atol=1e-5)
    assert np.all(found <= known + 1e-5)
    assert np.sum(~alike) > 50, "below the table: solid goes on there"
