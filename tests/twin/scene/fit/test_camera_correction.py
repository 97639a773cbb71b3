import numpy as np
import pytest
import textured_room

from bridge.geometry import se3
from twin.scene.fit.camera_correction import (
    CameraCorrections,
    align_view,
    corrected_pose,
    correction_gradient,
)
from twin.scene.fit.initialise import fuse
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, Target, training_view
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.settings import InitialiseConfig

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)


def test_the_gradient_on_a_correction_agrees_with_finite_differences() -> None:
    rng = np.random.default_rng(3)
    T_base_camera = textured_room.camera_pose(1, 4)
    d_matrix = rng.normal(size=(3, 4))

    def value(correction: np.ndarray) -> float:
        T_camera_base = se3.invert(corrected_pose(T_base_camera, correction))
        return float((d_matrix * T_camera_base[:3]).sum())

    step = 1e-6
    expected = [(value(step * e) - value(-step * e)) / (2 * step) for e in np.eye(6)]
    found = correction_gradient(d_matrix, T_base_camera)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8)


def test_the_first_view_never_moves_and_the_prior_holds_the_others() -> None:
    cameras = CameraCorrections.none(3)
    T = textured_room.camera_pose(0, 3)
    pull = np.array([1.0, -1.0, 0.5, 1.0, 1.0, -2.0])
    for _ in range(5):
        cameras.update(0, pull, 1.0)
        cameras.update(1, pull, 1.0)
    np.testing.assert_array_equal(cameras.pose(0, T), T)
    assert np.all(cameras.values[1] * pull < 0)
    far = CameraCorrections.none(3)
    far.values[2] = 0.1
    for _ in range(20):
        far.update(2, np.zeros(6), 1.0)
    assert np.all(far.values[2] < 0.1)


@pytest.fixture(scope="module")
def seen() -> tuple[GaussianCloud, Target, Target]:
    """A cloud, and exactly what it looks like from one view, a little darker."""
    surfaces = [FrameSurface(textured_room.frame(i, 4), LIMITS) for i in range(4)]
    cloud = fuse([surface.points() for surface in surfaces], InitialiseConfig(max_splats=1500))
    view = training_view(surfaces[1])
    rasteriser = Rasteriser(RasterConfig(threads=1))
    targets = []
    for target in (view.half, view.full):
        image = rasteriser.draw_planes(cloud, target.camera, view.T_base_color)[:3]
        image_u8 = np.rint(np.clip(0.8 * image, 0, 1) * 255).astype(np.uint8)
        targets.append(
            Target(
                camera=target.camera,
                planes_u8=image_u8,
                depth_m=target.depth_m,
                static_mask=target.static_mask,
            )
        )
    return cloud, targets[0], targets[1]


def test_an_image_is_aligned_with_the_scene(seen: tuple[GaussianCloud, Target, Target]) -> None:
    cloud, half, full = seen
    true = textured_room.camera_pose(1, 4)
    begin = corrected_pose(true, np.array([0.004, -0.005, 0.003, 0.006, -0.004, 0.005]))
    found = align_view(cloud, half, full, begin, Rasteriser(RasterConfig(threads=1)))

    def off(T: np.ndarray) -> tuple[float, float]:
        apart = se3.invert(true) @ T
        return float(np.linalg.norm(apart[:3, 3])), float(se3.rotation_angle_rad(apart[:3, :3]))

    assert off(found.T_base_camera)[0] < 0.4 * off(begin)[0]
    assert off(found.T_base_camera)[1] < 0.3 * off(begin)[1]
    np.testing.assert_allclose(found.gain, 0.8, atol=0.01)
    assert np.abs(found.image - full.image()).mean() < 0.01
