"""A fused step equals drawing, comparing, pulling back and Adam one after another."""

from typing import Literal

import numpy as np
import pytest
from clouds import any_cloud
from reference_loss import Loss
from splat_pull import gradient_of, pull_back

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.frames.rgbd import Target
from twin.scene.gaussians import GaussianCloud, arrays, as_float32
from twin.scene.raster.rasteriser import (
    FitSession,
    RasterConfig,
    Rasteriser,
    ThreadPace,
    load_native,
)

CAMERA = Camera(width=61, height=94, fx=70.0, fy=70.0, cx=30.0, cy=47.0)
RATES = {
    "means_m": 1e-3,
    "quats_wxyz": 1e-2,
    "scales_log": 2e-2,
    "opacities_logit": 5e-2,
    "colors": 2e-2,
    "harmonics": 3e-3,
}
GAIN = np.diag([0.9, 1.05, 1.2]) @ np.eye(3, 4)
MIXED = np.array([[0.9, 0.1, -0.05, 0.02], [-0.08, 1.05, 0.03, -0.03], [0.02, -0.04, 1.2, 0.01]])


def some_cloud(count: int = 400, num_harmonics: int = 3) -> GaussianCloud:
    box = [[-0.5, -0.7, 0.8], [0.5, 0.7, 2.0]]
    return any_cloud(1, count, box, (0.02, 0.1), harmonics=num_harmonics)


def some_target(*, masked: bool = True) -> Target:
    rng = np.random.default_rng(2)
    size = (CAMERA.height, CAMERA.width)
    static = np.ones(size, dtype=bool)
    if masked:
        static[20:40, 10:35] = False
    depth = rng.uniform(0.8, 2.0, size).astype(np.float32)
    depth[rng.uniform(size=size) < 0.2] = 0.0
    return Target(
        camera=CAMERA,
        planes_u8=rng.integers(0, 256, (3, *size), dtype=np.uint8),
        depth_m=np.where(static, depth, np.float32(0.0)),
        static_mask=static,
    )


def a_pose() -> np.ndarray:
    return se3.look_at(
        np.array([0.1, -0.1, -0.2]), np.array([0.0, 0.0, 1.4]), np.array([0.0, -1.0, 0.0])
    )


class SeparateSteps:
    """What ``FitSession`` fuses, written with the public parts."""

    def __init__(self, cloud: GaussianCloud, loss: Loss) -> None:
        """Copy the cloud; moments start at zero."""
        self.cloud = GaussianCloud(**{name: rows.copy() for name, rows in arrays(cloud)})
        self.loss = loss
        self.moments = {
            name: (np.zeros_like(rows), np.zeros_like(rows)) for name, rows in arrays(cloud)
        }
        self.rasteriser = Rasteriser(RasterConfig(threads=1))
        self.steps = 0

    def step(self, target: Target, exposure: np.ndarray) -> tuple[float, float, np.ndarray]:
        self.steps += 1
        planes = self.rasteriser.draw_planes(self.cloud, target.camera, a_pose())
        E = as_float32(exposure)
        seen = planes.copy()
        seen[:3] = np.einsum("ck,khw->chw", E[:, :3], planes[:3]) + E[:, 3, None, None]
        wanted = np.where(target.static_mask, target.image(), seen[:3])
        value, mse, upstream = self.loss(seen, wanted, target.depth_m)
        d_drawn = upstream.copy()
        d_drawn[:3] = np.einsum("ck,chw->khw", E[:, :3], upstream[:3])
        gradient = pull_back(self.rasteriser, planes, d_drawn)
        for name, rows in arrays(self.cloud):
            first, second = self.moments[name]
            load_native().adam_step(
                rows, getattr(gradient, name), first, second, self.steps, RATES[name]
            )
        d_gain = (upstream[:3].astype(np.float64) * planes[:3]).sum(axis=(1, 2))
        self.gradient = gradient
        return value, mse / float(target.static_mask.mean()), d_gain


@pytest.mark.parametrize("kind", ["3dgs", "paper"])
@pytest.mark.parametrize(("num_harmonics", "exposure"), [(0, GAIN), (3, GAIN), (3, MIXED)])
def test_a_fused_step_equals_the_separate_steps(
    kind: Literal["3dgs", "paper"], num_harmonics: int, exposure: np.ndarray
) -> None:
    cloud, target = some_cloud(num_harmonics=num_harmonics), some_target()
    session = FitSession(cloud, RasterConfig(threads=1), loss=kind, depth_weight=0.3)
    separate = SeparateSteps(cloud, Loss(kind, depth_weight=0.3, threads=1))
    for count in range(4):
        report = session.step(target, a_pose(), RATES, exposure)
        loss, mse, d_gain = separate.step(target, exposure)
        assert report.loss == pytest.approx(loss, rel=1e-4)
        assert report.mse == pytest.approx(mse, rel=1e-4)
        np.testing.assert_allclose(report.gain, d_gain, rtol=2e-3, atol=1e-5)
        pose = separate.gradient.T_camera_base
        assert np.abs(report.T_camera_base - pose).max() < 5e-3 * np.abs(pose).max()
        if count == 0:
            found = gradient_of(session, report)
            for name, _ in arrays(cloud):
                wanted = getattr(separate.gradient, name)
                error = np.linalg.norm(getattr(found, name) - wanted)
                assert error < 1e-4 * np.linalg.norm(wanted), name
    for name, rows in arrays(separate.cloud):
        moved = np.abs(rows - getattr(cloud, name)).max()
        difference = np.abs(getattr(session.cloud, name) - rows)
        assert moved > 0
        # Adam divides by the gradient's size: where that is rounding, directions may differ.
        assert np.quantile(difference, 0.98) < 0.02 * moved, name


@pytest.mark.parametrize("exposure", [GAIN, MIXED])
def test_a_step_follows_a_finite_difference_of_the_gain(exposure: np.ndarray) -> None:
    cloud, target = some_cloud(), some_target()
    session = FitSession(cloud, RasterConfig(threads=1, alpha_cut=2.0**-24), loss="paper")
    gradient = session.step(target, a_pose(), {}, exposure).gain
    for channel in range(3):
        losses = []
        for sign in (1, -1):
            other = exposure.copy()
            other[channel, channel] += sign * 1e-2
            losses.append(session.step(target, a_pose(), {}, other).loss)
        assert (losses[0] - losses[1]) / 2e-2 == pytest.approx(gradient[channel], rel=1e-2)


def test_an_image_that_is_masked_everywhere_teaches_nothing() -> None:
    target = some_target()
    nothing = Target(
        camera=CAMERA,
        planes_u8=target.planes_u8,
        depth_m=np.zeros_like(target.depth_m),
        static_mask=np.zeros_like(target.static_mask),
    )
    cloud = some_cloud()
    session = FitSession(cloud, RasterConfig(threads=1), loss="paper")
    report = session.step(nothing, a_pose(), RATES)
    assert report.mse is None
    assert report.loss == 0.0
    for name, rows in arrays(cloud):
        np.testing.assert_array_equal(getattr(session.cloud, name), rows)


def test_moments_go_along_with_their_gaussians() -> None:
    session = FitSession(some_cloud(10), RasterConfig(threads=1))
    session.step(some_target(), a_pose(), RATES)
    parents = np.array([7, 7, 2])
    moved = session.cloud.take(parents)
    twin = FitSession(moved, RasterConfig(threads=1))
    session.rearrange(moved, parents)
    assert session.steps == 1
    report = session.step(some_target(), a_pose(), RATES)
    other = twin.step(some_target(), a_pose(), RATES)
    assert report.loss == other.loss
    assert not np.array_equal(session.cloud.means_m[0], twin.cloud.means_m[0])


@pytest.mark.parametrize(("alone_s", "both_s"), [(0.028, 0.095), (0.028, 0.015), (0.028, 0.029)])
def test_two_threads_are_never_much_slower_than_one(alone_s: float, both_s: float) -> None:
    pace, total_s = ThreadPace(2), 0.0
    for _ in range(2000):
        count = pace.choose(9)
        seconds = alone_s if count == 1 else both_s
        pace.took(9, count, seconds)
        total_s += seconds
    assert total_s < 1.03 * 2000 * min(alone_s, both_s)
