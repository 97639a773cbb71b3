"""Gaussians follow soft bodies: rigid motions exactly, bending smoothly."""

import numpy as np
import pytest
from clouds import any_cloud
from seen_colors import effective_colors

from bridge.geometry import se3
from twin.scene.gaussians import GaussianCloud, moved_cloud
from twin.scene.skinning import SkinError, bind, pose_cloud


@pytest.fixture
def nodes() -> np.ndarray:
    steps = np.arange(5) * 0.015
    return np.stack(np.meshgrid(steps, steps, steps[:3]), axis=-1).reshape(-1, 3)


@pytest.fixture
def cloud(nodes: np.ndarray) -> GaussianCloud:
    box = [nodes.min(axis=0) - 0.005, nodes.max(axis=0) + 0.005]
    return any_cloud(3, 300, box, (0.002, 0.003), harmonics=3)


def covariances(cloud: GaussianCloud) -> np.ndarray:
    q = cloud.quats_wxyz.astype(np.float64)
    R = se3.rotation_from_quaternion(q / np.linalg.norm(q, axis=1, keepdims=True))
    scaled = R * np.exp(cloud.scales_log.astype(np.float64))[:, None, :]
    return np.asarray(scaled @ np.swapaxes(scaled, 1, 2))


def some_pose(angle_rad: float = 2.6) -> np.ndarray:
    axis = np.array([0.48, -0.6, 0.64])
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(axis * angle_rad)
    T[:3, 3] = 0.3, -0.2, 0.15
    return T


@pytest.mark.parametrize("angle_rad", [0.0, 0.4, 2.6, np.pi])
def test_a_rigid_motion_of_the_nodes_moves_every_gaussian_rigidly(
    cloud: GaussianCloud, nodes: np.ndarray, angle_rad: float
) -> None:
    T = some_pose(angle_rad)
    posed = pose_cloud(cloud, bind(cloud.means_m, nodes), se3.apply(T, nodes))
    expected = moved_cloud(cloud, T)
    np.testing.assert_allclose(posed.means_m, expected.means_m, atol=1e-6)
    np.testing.assert_allclose(covariances(posed), covariances(expected), rtol=1e-4, atol=1e-11)
    eye = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        effective_colors(posed, eye), effective_colors(expected, eye), atol=1e-5
    )


def test_what_does_not_fit_is_refused(nodes: np.ndarray, cloud: GaussianCloud) -> None:
    binding = bind(cloud.means_m, nodes)
    with pytest.raises(SkinError, match="300 Gaussians and 74 nodes"):
        pose_cloud(cloud, binding, nodes[1:])
    with pytest.raises(SkinError, match="burst"):
        pose_cloud(cloud, binding, np.full_like(nodes, np.nan))
    with pytest.raises(SkinError, match="finer"):
        bind(cloud.means_m, nodes[:6])
