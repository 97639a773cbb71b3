"""The sliding window: what plain sums over every window say, at every size."""

import numpy as np
import pytest

from bridge.media.image_quality import BORDER, C1, C2, PADDINGS, SIGMA, WINDOW, ssim_maps

SIZES = [(11, 11), (11, 40), (43, 12), (26, 27), (37, 101), (64, 48)]


def pair(size: tuple[int, int], channels: int = 2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(size)
    first = rng.random((*size, channels))
    return first, np.clip(first + rng.normal(0, 0.2, first.shape), 0, 1)


def plain_map(first: np.ndarray, second: np.ndarray, padding: str) -> np.ndarray:
    """SSIM as its definition has it: weighted means over each window, one window at a time."""
    if padding != "valid":
        edges = ((BORDER, BORDER), (BORDER, BORDER), (0, 0))
        first, second = (np.pad(i, edges) for i in (first, second))
    bell = np.exp(-0.5 * ((np.arange(WINDOW) - BORDER) / SIGMA) ** 2)
    weights = np.outer(bell, bell) / bell.sum() ** 2
    views = [
        np.lib.stride_tricks.sliding_window_view(image, (WINDOW, WINDOW), axis=(0, 1))
        for image in (first, second)
    ]
    a, b = views
    mean_a, mean_b = ((v * weights).sum(axis=(-2, -1)) for v in views)
    var_a = ((a - mean_a[..., None, None]) ** 2 * weights).sum(axis=(-2, -1))
    var_b = ((b - mean_b[..., None, None]) ** 2 * weights).sum(axis=(-2, -1))
    shared = (a - mean_a[..., None, None]) * (b - mean_b[..., None, None])
    cov = (shared * weights).sum(axis=(-2, -1))
    bright = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return np.asarray(bright * (2 * cov + C2) / (var_a + var_b + C2))


def windows(first: np.ndarray, second: np.ndarray, padding: str) -> np.ndarray:
    inner = slice(BORDER, -BORDER) if padding == "valid" else slice(None)
    return ssim_maps(first, second).zero[inner, inner]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("padding", PADDINGS)
def test_every_window_says_what_its_definition_says(size: tuple[int, int], padding: str) -> None:
    first, second = pair(size)
    expected = plain_map(first, second, padding)
    found = windows(first, second, padding)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
    assert ssim_maps(first, second).mean(padding) == pytest.approx(expected.mean(), abs=1e-12)


@pytest.mark.parametrize("padding", PADDINGS)
def test_a_value_that_is_no_number_leaves_no_score(padding: str) -> None:
    first, second = pair((40, 30))
    whole = windows(first, second, padding)
    second[3, 20, 1] = np.nan
    spoilt = windows(first, second, padding)
    np.testing.assert_array_equal(spoilt[..., 0], whole[..., 0])
    assert np.isnan(spoilt[..., 1].mean())
