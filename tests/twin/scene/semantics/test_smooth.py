import numpy as np
import pytest

from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.semantics.associate import SmoothConfig, smooth_shares


def sheet(side: int = 24) -> tuple[GaussianCloud, np.ndarray]:
    """A flat sheet, red on the left, blue on the right; who is red."""
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    p = np.column_stack([x.ravel(), y.ravel(), np.zeros(side**2)]) * 0.003
    red = x.ravel() < side // 2
    return GaussianCloud(
        means_m=as_float32(p),
        quats_wxyz=as_float32(np.tile([1.0, 0, 0, 0], (len(p), 1))),
        scales_log=np.full((len(p), 3), -6.0, dtype=np.float32),
        opacities_logit=np.full(len(p), 3.0, dtype=np.float32),
        colors=as_float32(np.where(red[:, None], [0.8, 0.1, 0.1], [0.1, 0.2, 0.8])),
    ), red


def test_an_edge_that_bleeds_comes_back_to_the_edge_of_the_colour() -> None:
    cloud, red = sheet()
    x = cloud.means_m[:, 0] / 0.003
    share = np.where(red, 0.9, np.where(x < 14, 0.6, 0.05)).astype(np.float32)[None]
    smoothed = smooth_shares(share, cloud, SmoothConfig())
    wrong_before = ((share[0] > 0.5) != red).mean()
    wrong_after = ((smoothed[0] > 0.5) != red).mean()
    assert wrong_before > 0.08
    assert wrong_after < 0.02


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_what_everybody_agrees_on_stays(value: float) -> None:
    cloud, _ = sheet()
    share = np.full((2, len(cloud)), value, dtype=np.float32)
    np.testing.assert_allclose(smooth_shares(share, cloud, SmoothConfig()), share, atol=1e-5)


def test_shares_stay_between_zero_and_one() -> None:
    cloud, _ = sheet()
    share = np.random.default_rng(0).uniform(size=(3, len(cloud))).astype(np.float32)
    smoothed = smooth_shares(share, cloud, SmoothConfig())
    assert smoothed.min() >= 0.0
    assert smoothed.max() <= 1.0
    assert smoothed.std() < share.std()


def test_the_order_of_gaussians_does_not_matter() -> None:
    cloud, _ = sheet()
    rng = np.random.default_rng(1)
    share = rng.uniform(size=(1, len(cloud))).astype(np.float32)
    order = rng.permutation(len(cloud))
    first = smooth_shares(share, cloud, SmoothConfig())
    second = smooth_shares(share[:, order], cloud.take(order), SmoothConfig())
    # Of neighbours equally far away either may be the twelfth.
    assert np.abs(first[:, order] - second).mean() < 0.03


def test_nothing_told_is_nothing_smoothed() -> None:
    cloud, _ = sheet()
    nothing = np.zeros((0, len(cloud)), dtype=np.float32)
    assert smooth_shares(nothing, cloud, SmoothConfig()).shape == nothing.shape
