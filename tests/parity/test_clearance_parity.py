"""Clearance in C++ against every point and coal, and coal against python-fcl."""

from itertools import combinations

import coal
import fcl
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import ConvexHull

from bridge.geometry.mesh import box_corners
from bridge.robots.default import ROBOT
from twin.plan.constrain.distances import boxes_clearance, grid_clearance
from twin.replay.clearance.bodies import NearPairs, half_space_solid, solid_of
from twin.replay.clearance.bounding_spheres import FINE_M, BoundingSpheres, bounding_spheres_of
from twin.robot.collision import RobotHulls, convex_hull, hulls_of, signed_distance
from twin.robot.model import load_robot
from twin.scene.shape.sdf import SdfGrid, distances_of_solid

pytestmark = pytest.mark.parity


@pytest.fixture(scope="module")
def grid() -> SdfGrid:
    """Blobs of 8 mm voxels."""
    noise = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(60, 50, 40)), 4)
    solid = noise > np.quantile(noise, 0.9)
    values = distances_of_solid(solid, 0.008)
    return SdfGrid(values_m=values, origin_m=np.array([-0.2, 0.1, 0.0]), voxel_m=0.008)


def in_numpy(grid: SdfGrid, points: np.ndarray) -> np.ndarray:
    """Trilinear; beyond the grid what is sure of its nearest point."""
    place = (points - grid.origin_m) / grid.voxel_m
    held = np.clip(place, 0.0, np.array(grid.values_m.shape) - 1.0)
    value = ndimage.map_coordinates(grid.values_m, held.T, output=np.float64, order=1)
    e = np.linalg.norm(place - held, axis=1) * grid.voxel_m
    return np.where(value > 0, np.hypot(value, e), value + e)


def poses(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Anywhere in the grid, and outside of it."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    R = q * np.sign(np.linalg.det(q))[:, None, None]
    return np.ascontiguousarray(R), rng.uniform([-0.4, -0.1, -0.2], [0.5, 0.7, 0.5], (count, 3))


def test_no_point_is_nearer_than_the_tree_says(grid: SdfGrid) -> None:
    rng = np.random.default_rng(2)
    pieces = [bounding_spheres_of(rng.uniform(-s, s, (25, 3))) for s in (0.02, 0.05, 0.08)]
    together = BoundingSpheres(pieces)
    inside = 0
    for seed in range(40):
        R, t = poses(3, seed)
        found = together.distances_m(grid, R, t)
        for piece, R_one, t_one, distance in zip(pieces, R, t, found, strict=True):
            finest_m = piece.points_m[piece.children[:, 0] == piece.children[:, 1]]
            every = in_numpy(grid, finest_m @ R_one.T + t_one).min()
            assert distance + FINE_M <= max(every, 0.98 * every) + 1e-5
            assert distance + FINE_M >= min(every, 0.98 * every) - 1e-5
            inside += distance < 0
    assert 10 < inside < 110


def bound_in_numpy(near: NearPairs, solids: list, one: int, other: int) -> float:
    """What boxes and spheres leave between two bodies, seen from either body."""
    found = []
    c = [near.R[i] @ solids[i].centre + near.t[i] for i in (one, other)]
    found.append(np.linalg.norm(c[1] - c[0]) - solids[one].radius_m - solids[other].radius_m)
    for a, b, way in ((one, other, c[1] - c[0]), (other, one, c[0] - c[1])):
        ball = np.abs(near.R[a].T @ way) - solids[a].half_m
        box = ball - np.abs(near.R[a].T @ near.R[b]) @ solids[b].half_m
        for gap, radius in ((ball, solids[b].radius_m), (box, 0.0)):
            outside = np.linalg.norm(np.maximum(gap, 0.0)) if gap.max() > 0 else gap.max()
            found.append(outside - radius)
    return max(found) - 1e-6


def test_bounds_are_those_of_numpy_and_never_above_what_coal_measures() -> None:
    rng = np.random.default_rng(5)
    points = [rng.normal(size=(30, 3)) * rng.uniform(0.01, 0.1, 3) for _ in range(6)]
    points += [box_corners(rng.uniform(0.02, 0.1, 3)) for _ in range(4)]
    solids = [solid_of("body", convex_hull(p), p) for p in points]
    pairs = list(combinations(range(10), 2))
    solids.append(half_space_solid("table"))
    pairs += [(index, 10) for index in range(10)]
    near = NearPairs(solids, pairs)
    exact = apart = 0
    for seed in range(20):
        near.R[:10], near.t[:10] = poses(10, seed)
        placed = [coal.Transform3s(R, t) for R, t in zip(near.R, near.t, strict=True)]
        bounds = list(near.nearest_first())
        assert bounds == sorted(bounds)
        assert sorted(index for _, index in bounds) == list(range(len(pairs)))
        for bound, index in bounds:
            one, other = pairs[index]
            assert bound == pytest.approx(bound_in_numpy(near, solids, one, other), abs=1e-12)
            distance = signed_distance(
                solids[one].shape, placed[one], solids[other].shape, placed[other]
            )
            assert bound <= distance
            apart += bound > 0
            exact += bound > 0 and distance - bound < 0.01
    assert apart > 700
    assert exact > 0.2 * apart  # boxes about random hulls are loose


def test_pairs_that_are_left_out_are_farther_apart_than_was_asked() -> None:
    """Whatever was asked before: what parted a pair last time is tried first."""
    rng = np.random.default_rng(8)
    points = [rng.normal(size=(40, 3)) * rng.uniform(0.01, 0.1, 3) for _ in range(6)]
    points += [box_corners(rng.uniform(0.02, 0.1, 3)) for _ in range(3)]
    solids = [solid_of("body", convex_hull(p), p) for p in points]
    solids.append(half_space_solid("table"))
    pairs = list(combinations(range(10), 2))
    near = NearPairs(solids, pairs)
    kept = parted = beyond = 0
    for seed in range(12):
        near.R[:9], near.t[:9] = poses(9, seed)
        bounds = {index: bound for bound, index in near.nearest_first()}
        placed = [coal.Transform3s(R, t) for R, t in zip(near.R, near.t, strict=True)]
        measured = {
            index: signed_distance(solids[a].shape, placed[a], solids[b].shape, placed[b])
            for index, (a, b) in enumerate(pairs)
        }
        for up_to_m in (0.03, -0.005, 0.0, 0.002):
            few = list(near.nearest_first(up_to_m))
            assert few == sorted(few)
            assert all(bound == bounds[index] <= up_to_m for bound, index in few)
            left = {index for _, index in few}
            assert left >= {index for index, distance in measured.items() if distance <= up_to_m}
            kept += len(left)
            parted += sum(bounds[index] <= up_to_m for index in set(bounds) - left)
            if up_to_m >= 0:  # depths are not looked for
                hulls = [index for index in left if 9 not in pairs[index]]
                beyond += sum(measured[index] > up_to_m + 1e-5 for index in hulls)
    assert kept > 100
    assert parted > 100
    assert beyond == 0


def bodies(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a body, and poses of it as matrices."""
    R, t = poses(count, seed)
    Ts = np.repeat(np.eye(4)[None], count, axis=0)
    Ts[:, :3, :3], Ts[:, :3, 3] = R, t
    return np.random.default_rng(seed).uniform(-0.04, 0.04, (60, 3)), Ts


def distances_to_boxes(boxes: list, points: np.ndarray, Ts: np.ndarray) -> np.ndarray:
    """Of every point of every pose to every box."""
    placed = np.einsum("nij,pj->npi", Ts[:, :3, :3], points) + Ts[:, None, :3, 3]
    found = []
    for T, extents in boxes:
        q = np.abs((placed - T[:3, 3]) @ T[:3, :3]) - extents / 2
        found.append(np.linalg.norm(np.maximum(q, 0), axis=2) + np.minimum(q.max(axis=2), 0))
    return np.stack(found, axis=2)


def some_boxes(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    points, Ts = bodies(count, 11)
    return [(T, np.abs(p) * 8 + 0.01) for T, p in zip(Ts, points, strict=False)]


def test_a_surface_is_as_near_to_boxes_as_its_nearest_point() -> None:
    boxes = some_boxes(6)
    points, Ts = bodies(200, 12)
    every = distances_to_boxes(boxes, points, Ts)
    found = boxes_clearance(boxes)(points, Ts)
    np.testing.assert_allclose(found, every.min(axis=(1, 2)), atol=1e-12)
    assert (found < 0).sum() > 20


def test_a_surface_is_as_near_to_a_grid_as_its_nearest_point(grid: SdfGrid) -> None:
    points, Ts = bodies(150, 13)
    placed = np.einsum("nij,pj->npi", Ts[:, :3, :3], points) + Ts[:, None, :3, 3]
    to_grid = in_numpy(grid, placed.reshape(-1, 3)).reshape(150, -1)
    nearest = grid_clearance(grid, points, Ts)
    np.testing.assert_allclose(nearest, to_grid.min(axis=1), atol=1e-6)


TOLERANCE_M = 1e-6
CONFIGURATIONS = 5
BOXES_M = ((0.03, 0.03, 0.03), (0.2, 0.15, 0.08), (1.2, 0.9, 0.04))
"""A cube, a box, a table top."""


@pytest.fixture(scope="module")
def hulls() -> RobotHulls:
    return hulls_of(load_robot(ROBOT.urdf_text()))


def fcl_convex(shape: coal.ConvexBase) -> fcl.Convex:
    """Build the polytope of the same corners; its faces come from scipy, not from coal."""
    corners = np.array(shape.points())
    hull = ConvexHull(corners)
    used = np.unique(hull.simplices)
    inside = corners[used].mean(axis=0)
    faces = []
    for triangle in hull.simplices:
        a, b, c = corners[triangle]
        outward = np.dot(np.cross(b - a, c - a), a - inside) > 0
        faces += [3, *(triangle if outward else triangle[::-1]).tolist()]
    return fcl.Convex(corners, len(hull.simplices), np.array(faces))


def fcl_transform(T: coal.Transform3s) -> fcl.Transform:
    return fcl.Transform(np.array(T.getRotation()), np.array(T.getTranslation()))


def fcl_distance(first: fcl.CollisionObject, second: fcl.CollisionObject) -> float:
    """Distance [m]; -1 where the two overlap."""
    request = fcl.DistanceRequest(gjk_solver_type=fcl.GJKSolverType.GST_INDEP)
    return float(fcl.distance(first, second, request, fcl.DistanceResult()))


def box_near(rng: np.random.Generator, centre_m: np.ndarray) -> coal.Transform3s:
    """Turn a box at random and put it up to 30 cm from a point."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R = q * np.sign(np.linalg.det(q))
    return coal.Transform3s(R, centre_m + rng.uniform(-0.3, 0.3, 3))


def test_hulls_and_boxes_are_as_far_apart_as_fcl_says(hulls: RobotHulls) -> None:
    rng = np.random.default_rng(5)
    references = [fcl_convex(hull.shape) for hull in hulls.hulls]
    apart, overlapping, worst = 0, 0, 0.0
    for _ in range(CONFIGURATIONS):
        hulls.place(rng.uniform(-np.pi, np.pi, 6), rng.uniform(0, 0.085))
        for size in BOXES_M:
            for index, (hull, reference) in enumerate(zip(hulls.hulls, references, strict=True)):
                placed = hulls.placement(index)
                T_box = box_near(rng, np.array(placed.getTranslation()))
                ours = signed_distance(hull.shape, placed, coal.Box(*size), T_box)
                theirs = fcl_distance(
                    fcl.CollisionObject(reference, fcl_transform(placed)),
                    fcl.CollisionObject(fcl.Box(*size), fcl_transform(T_box)),
                )
                assert (ours > 0) == (theirs > 0), (hull.link, size, ours, theirs)
                if ours > 0:
                    worst = max(worst, abs(ours - theirs))
                    apart += 1
                else:
                    overlapping += 1
    assert worst < TOLERANCE_M
    assert apart > 60
    assert overlapping > 20


def test_the_reference_notices_a_hull_that_is_a_millimetre_off(hulls: RobotHulls) -> None:
    """Checks the comparison itself: a shifted link must not pass."""
    hulls.place(np.zeros(6), 0.04)
    hull, placed = hulls.hulls[2], hulls.placement(2)
    lifted = np.array(placed.getTranslation()) + np.array([0, 0, 1e-3])
    moved = coal.Transform3s(placed.getRotation(), lifted)
    T_box = coal.Transform3s(np.eye(3), np.array([0.2, 0.0, 1.5]))
    ours = signed_distance(hull.shape, placed, coal.Box(0.1, 0.1, 0.1), T_box)
    box = fcl.CollisionObject(fcl.Box(0.1, 0.1, 0.1), fcl_transform(T_box))
    reference = fcl_convex(hull.shape)
    same = fcl_distance(fcl.CollisionObject(reference, fcl_transform(placed)), box)
    shifted = fcl_distance(fcl.CollisionObject(reference, fcl_transform(moved)), box)
    assert ours == pytest.approx(same, abs=TOLERANCE_M)
    assert abs(ours - shifted) > 100 * TOLERANCE_M


def test_touching_from_inside_and_outside_is_told_apart_by_both() -> None:
    """A box against a hull that is a box: the exact answer is known, on either side of 0."""
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05
    shape = convex_hull(cube)
    for gap in (-0.02, -1e-4, 1e-4, 0.02):
        T_box = coal.Transform3s(np.eye(3), np.array([0.1 + gap, 0.01, 0.0]))
        ours = signed_distance(shape, coal.Transform3s(), coal.Box(0.1, 0.1, 0.1), T_box)
        theirs = fcl_distance(
            fcl.CollisionObject(fcl_convex(shape), fcl_transform(coal.Transform3s())),
            fcl.CollisionObject(fcl.Box(0.1, 0.1, 0.1), fcl_transform(T_box)),
        )
        assert ours == pytest.approx(gap, abs=TOLERANCE_M)
        assert (theirs > 0) == (gap > 0)
        if gap > 0:
            assert theirs == pytest.approx(gap, abs=TOLERANCE_M)
