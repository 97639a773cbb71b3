"""Laws of laying shapes onto what was seen: exact data give the exact pose; edges lie on edges."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.task.task_file import load_task
from twin.scene.localise.mesh_fit import _icp, _Problem, facing, mesh_surface
from twin.scene.localise.outline import _crossings
from twin.scene.localise.points import CameraView, Cluster
from twin.scene.shape.known import pose_of, shape_mesh

SIZE_M = (0.09, 0.03, 0.05)
NOTHING = {
    "depth_m": np.zeros((4, 4)),
    "image_linear": np.zeros((4, 4, 3)),
    "p_base": np.zeros((0, 3)),
    "color_linear": np.zeros((0, 3)),
}


def view_from(p_m: np.ndarray) -> CameraView:
    """A camera that stands there and looks anywhere."""
    camera = Camera(width=4, height=4, fx=4.0, fy=4.0, cx=2.0, cy=2.0)
    T = se3.from_rotation(np.eye(3), p_m)
    return CameraView(
        camera_id="side",
        stamp_ns=1,
        num_frames=1,
        color_camera=camera,
        depth_camera=camera,
        T_base_color=T,
        T_base_depth=T,
        **NOTHING,
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("turn_rad", [0.15, -0.15])
def test_exact_points_give_the_exact_pose_from_a_pose_nearby(seed: int, turn_rad: float) -> None:
    model = replace(load_task("cube_into_box").objects["cube"], size_m=SIZE_M)
    T = pose_of(np.array([0.5, -0.1, SIZE_M[2] / 2, 0.3 * seed]))
    view = view_from(se3.apply(T, np.array([[0.4, -0.4, 0.6]]))[0])  # sees two sides and the top
    surface = mesh_surface(*shape_mesh(model), 20_000)
    seen = surface.p_m[facing(se3.invert(T), view, surface)][3::20]
    cluster = Cluster(p_base=se3.apply(T, seen), view_ids=np.zeros(len(seen), dtype=np.int64))
    problem = _Problem(
        surface=surface,
        cluster=cluster,
        points=cluster.by_view(1),
        views=[view],
        tilt_sigma_rad=1e-5,
        prior=np.full(2, 1e12),  # the points have no shift of their own
    )
    start = pose_of(np.array([0.504, -0.103, SIZE_M[2] / 2, 0.3 * seed + turn_rad]))
    found, shifts = _icp(start, np.zeros((1, 2)), problem, iterations=30, wide=2.0)
    np.testing.assert_allclose(found[:3, 3], T[:3, 3], atol=2e-4)
    assert se3.rotation_angle_rad(found[:3, :3].T @ T[:3, :3]) < 2e-3
    assert np.abs(shifts).max() < 1e-6


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
