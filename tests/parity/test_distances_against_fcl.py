"""Signed distances of the robot's hulls (coal) against python-fcl, another library's own code."""

import coal
import fcl
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from bridge.robots.default import ROBOT
from twin.robot.collision import RobotHulls, convex_hull, hulls_of, signed_distance
from twin.robot.model import load_robot

pytestmark = pytest.mark.parity

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
