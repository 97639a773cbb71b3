"""Laws of laying shapes onto what was seen: exact data give the exact pose; edges lie on edges."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.geometry import se3
from bridge.task.task_file import load_task
from twin.scene.localise import shape_fit
from twin.scene.localise.points import Cluster
from twin.scene.localise.shape_fit import _crossings, _Problem, _solve
from twin.scene.shape.known import pose_of

SIZE_M = (0.09, 0.03, 0.05)


def surface_points(seed: int, count: int = 900) -> np.ndarray:
    """Points of five sides of a box that stands on its underside."""
    rng = np.random.default_rng(seed)
    half = np.array(SIZE_M) / 2
    points = rng.uniform(-half, half, (count, 3))
    side = rng.integers(0, 5, count)
    for number, (axis, sign) in enumerate(((0, 1), (0, -1), (1, 1), (1, -1), (2, 1))):
        points[side == number, axis] = sign * half[axis]
    return points


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("turn_rad", [0.15, -0.15])
def test_exact_points_give_the_exact_pose_from_a_pose_nearby(
    seed: int, turn_rad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shape_fit, "ITERATIONS", 30)
    cube = load_task("cube_into_box").objects["cube"]
    model = replace(cube, size_m=SIZE_M)
    yaw = 0.3 * seed
    q = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    T = se3.transform_from(q, np.array([0.5, -0.1, SIZE_M[2] / 2]))
    start = T.copy()
    start[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, turn_rad])) @ T[:3, :3]
    start[:2, 3] += [0.004, -0.003]
    points = se3.apply(T, surface_points(seed))
    cluster = Cluster(p_base=points, view_ids=np.zeros(len(points), dtype=np.int64))
    problem = _Problem(
        cluster=cluster.thinned(shape_fit.MAX_POINTS),
        outlines=(),
        model=model,
        prior_sigma=np.full((1, 3), 1e-6),  # the points have no shift of their own
    )
    yaw = np.arctan2(start[1, 0], start[0, 0])
    state = np.array([*start[:3, 3], yaw, 0.0, 0.0, 0.0])
    found = pose_of(_solve(state, problem)[:4])
    np.testing.assert_allclose(found[:3, 3], T[:3, 3], atol=2e-4)
    assert se3.rotation_angle_rad(found[:3, :3].T @ T[:3, :3]) < 2e-3


@given(st.integers(1, 10), st.integers(1, 8), st.booleans())
def test_an_edge_between_two_pixels_lies_between_them(
    column: int, row: int, is_inverse: bool
) -> None:
    """A pixel covers [i, i + 1): what ends with column i - 1 ends at i, and is left that way."""
    score = np.zeros((9, 12))
    score[:row, :column] = 1.0
    score = 1.0 - score if is_inverse else score
    edges, outward = _crossings(score)
    across = outward[:, 0] != 0
    assert across.sum() == row
    assert (~across).sum() == column
    np.testing.assert_allclose(edges[across, 0], column)
    np.testing.assert_allclose(np.sort(edges[across, 1]), np.arange(row) + 0.5)
    np.testing.assert_allclose(edges[~across, 1], row)
    assert set(outward[across, 0]) == {-1.0 if is_inverse else 1.0}
