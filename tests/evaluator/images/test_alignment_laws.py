"""Brightening a replayed image is least squares, channel by channel."""

import numpy as np
import pytest

from bridge.media.image_quality import aligned


def images(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two that differ in brightness and by noise, far from the ends of the range."""
    rng = np.random.default_rng(seed)
    replayed = rng.uniform(0.3, 0.6, (20, 30, 3))
    gains, offsets = rng.uniform(0.8, 1.2, 3), rng.uniform(-0.1, 0.1, 3)
    return gains * replayed + offsets + rng.normal(0, 0.01, replayed.shape), replayed


@pytest.mark.parametrize("seed", range(3))
def test_an_affine_alignment_is_the_line_that_fits_best(seed: int) -> None:
    recorded, replayed = images(seed)
    found = aligned(recorded, replayed, "affine")
    for channel in range(3):
        a, b = replayed[..., channel].ravel(), recorded[..., channel].ravel()
        np.testing.assert_allclose(
            found[..., channel].ravel(), np.polyval(np.polyfit(a, b, 1), a), atol=1e-9
        )


@pytest.mark.parametrize("seed", range(3))
def test_a_gain_is_the_factor_that_fits_best(seed: int) -> None:
    recorded, replayed = images(seed)
    found = aligned(recorded, replayed, "gain")
    for channel in range(3):
        a, b = replayed[..., channel].ravel(), recorded[..., channel].ravel()
        factor = np.linalg.lstsq(a[:, None], b, rcond=None)[0][0]
        np.testing.assert_allclose(found[..., channel].ravel(), factor * a, atol=1e-9)
    np.testing.assert_array_equal(aligned(recorded, replayed, "raw"), replayed)
