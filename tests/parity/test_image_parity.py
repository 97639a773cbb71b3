"""Image metrics against scikit-image, torchmetrics, the 3DGS convention, and plain definitions.

Each reference runs under its own settings, in float64; it agrees with the metric named after it.
"""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch.nn import functional

from bridge.media.image_quality import psnr_db, ssim_maps

pytestmark = pytest.mark.parity
EXACT = 1e-9
SIZES = [(12, 12), (32, 48), (61, 23)]


def pair(seed: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    blocks = rng.random((size[0] // 4 + 1, size[1] // 4 + 1, 3))
    smooth = np.kron(blocks, np.ones((4, 4, 1)))[: size[0], : size[1]]
    return smooth, np.clip(smooth + rng.normal(scale=0.05, size=smooth.shape), 0, 1)


def tensors(images: tuple[np.ndarray, np.ndarray]) -> list[torch.Tensor]:
    """Batches of one, channels first, float64."""
    return [torch.from_numpy(i.copy()).permute(2, 0, 1)[None].contiguous() for i in images]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", SIZES)
def test_scores_agree_with_scikit_image(seed: int, size: tuple[int, int]) -> None:
    recorded, replayed = pair(seed, size)
    assert psnr_db(recorded, replayed) == pytest.approx(
        peak_signal_noise_ratio(recorded, replayed, data_range=1.0), abs=EXACT
    )
    # use_sample_covariance=False and sigma=1.5 make scikit-image the window of Wang 2004; it
    # crops the border of half a window, as we do.
    theirs = structural_similarity(
        recorded,
        replayed,
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ssim_maps(recorded, replayed).mean("valid") == pytest.approx(theirs, abs=EXACT)


@pytest.mark.slow  # loading torchmetrics takes seconds
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", SIZES)
def test_scores_agree_with_torchmetrics(seed: int, size: tuple[int, int]) -> None:
    from torchmetrics.functional.image import (
        peak_signal_noise_ratio as their_psnr,
    )

    images = pair(seed, size)
    recorded, replayed = tensors(images)
    # torchmetrics multiplies by 10 / ln 10 in float32; in float64 it is the same number.
    rounded = float(10 / torch.log(torch.tensor(10.0)))
    psnr = float(their_psnr(replayed, recorded, data_range=1.0)) * (10 / math.log(10)) / rounded
    assert psnr_db(*images) == pytest.approx(psnr, abs=EXACT)


def splatting_ssim(recorded: torch.Tensor, replayed: torch.Tensor) -> float:
    """SSIM as papers on 3D Gaussian splatting compute it: one 11 x 11 window, padded with zeros."""
    reach = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-(reach**2) / (2 * 1.5**2))
    line /= line.sum()
    window = torch.outer(line, line).expand(3, 1, 11, 11)

    def windowed(image: torch.Tensor) -> torch.Tensor:
        return functional.conv2d(image, window, padding=5, groups=3)

    mean_a, mean_b = windowed(recorded), windowed(replayed)
    var_a = windowed(recorded * recorded) - mean_a**2
    var_b = windowed(replayed * replayed) - mean_b**2
    cov = windowed(recorded * replayed) - mean_a * mean_b
    top = (2 * mean_a * mean_b + 0.01**2) * (2 * cov + 0.03**2)
    return float((top / ((mean_a**2 + mean_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))).mean())


@pytest.mark.parametrize("size", SIZES)
def test_zero_padding_is_the_splatting_convention(size: tuple[int, int]) -> None:
    images = pair(0, size)
    theirs = splatting_ssim(*tensors(images))
    assert ssim_maps(*images).mean("zero") == pytest.approx(theirs, abs=EXACT)


def test_the_two_customs_are_two_numbers() -> None:
    maps = ssim_maps(*pair(0, (32, 48)))
    assert abs(maps.mean("valid") - maps.mean("zero")) > 1e-4
