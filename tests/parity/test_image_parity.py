"""PSNR and SSIM against scikit-image under the same protocol."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from evaluator.metrics.image import psnr_db, ssim

pytestmark = pytest.mark.parity


def pair(seed: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    smooth = np.kron(rng.random((size[0] // 4, size[1] // 4, 3)), np.ones((4, 4, 1)))
    return smooth, np.clip(smooth + rng.normal(scale=0.05, size=smooth.shape), 0, 1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [(12, 12), (32, 48), (60, 20)])
def test_scores_agree_with_scikit_image(seed: int, size: tuple[int, int]) -> None:
    recorded, replayed = pair(seed, size)
    assert psnr_db(recorded, replayed) == pytest.approx(
        peak_signal_noise_ratio(recorded, replayed, data_range=1.0), abs=1e-9
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
    assert ssim(recorded, replayed) == pytest.approx(theirs, abs=1e-9)
