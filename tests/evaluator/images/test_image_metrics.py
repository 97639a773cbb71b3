"""Image metrics: laws they must keep, and images that have no answer."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.media.image_quality import (
    PADDINGS,
    ImageShapeError,
    ssim,
    ssim_maps,
)
from evaluator.metrics.image import SwappedColourError, refuse_swapped
from evaluator.metrics.image_scores import METRICS, PLAIN_METRICS, score_image


def picture(seed: int = 0, size: tuple[int, int] = (40, 56)) -> np.ndarray:
    blocks = np.random.default_rng(seed).random((size[0] // 4, size[1] // 4, 3))
    image = np.kron(blocks, np.ones((4, 4, 1)))
    image.flags.writeable = False
    return image


def noisy(image: np.ndarray, scale: float) -> np.ndarray:
    return np.clip(image + np.random.default_rng(9).normal(scale=scale, size=image.shape), 0, 1)


@pytest.mark.parametrize("padding", PADDINGS)
def test_ssim_of_an_image_with_itself_is_one_under_every_padding(padding: str) -> None:
    image = picture()
    assert ssim(image, image, padding=padding) == pytest.approx(1.0)


def test_every_metric_is_worse_with_more_noise() -> None:
    image = picture(1, (176, 180))
    scores = [score_image(image, noisy(image, s)).values for s in (0.01, 0.05, 0.2)]
    for metric in PLAIN_METRICS:
        values = [values[metric.id] for values in scores]
        assert values == sorted(values, reverse=metric.higher_is_better), metric.id


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.01, 0.3))
def test_every_metric_is_symmetric(seed: int, scale: float) -> None:
    image = picture(seed)
    other = noisy(image, scale)
    there, back = (score_image(a, b).values for a, b in ((image, other), (other, image)))
    assert there == pytest.approx(back, abs=1e-12)


def test_a_mirrored_or_turned_pair_keeps_its_scores() -> None:
    image = picture(2)
    other = noisy(image, 0.1)
    turned = [np.rot90(i) for i in (image, other)]
    for padding in PADDINGS:
        expected = ssim(image, other, padding=padding)
        assert ssim(*turned, padding=padding) == pytest.approx(expected, abs=1e-12)


def test_paddings_differ_only_at_the_border() -> None:
    image = picture(3)
    maps = ssim_maps(image, noisy(image, 0.1))
    inner = slice(5, -5)
    np.testing.assert_array_equal(maps.reflect[inner, inner], maps.zero[inner, inner])
    assert (maps.reflect[:5] != maps.zero[:5]).mean() > 0.99


def test_a_black_background_flatters_and_single_pixels_do_not() -> None:
    image = picture(5, (176, 180))
    other = noisy(image, 0.1)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[60:90, 60:90] = True
    whole = score_image(image, other).values
    pixels = score_image(image, other, mask=mask, mode="mask-pixels").values
    black = score_image(image, other, mask=mask, mode="black-background").values
    assert black["ssim"] > whole["ssim"] + 0.1
    assert black["psnr_db"] > whole["psnr_db"] + 10
    assert pixels["psnr_db"] == pytest.approx(whole["psnr_db"], abs=1.0)


def test_metrics_alter_no_image() -> None:
    image = picture(7, (176, 176))
    other = noisy(image, 0.1)
    before = other.copy()
    other.flags.writeable = False
    score_image(image, other, alignment="affine")
    np.testing.assert_array_equal(other, before)


def test_too_small_images_say_what_they_lack() -> None:
    small = picture(0, (8, 8))
    score = score_image(small, noisy(small, 0.1))
    assert set(score.values) == {"psnr_db"}
    assert "window" in score.reasons["ssim_zero"]


def test_identical_images_have_no_psnr() -> None:
    image = picture()
    score = score_image(image, image)
    assert "identical" in score.reasons["psnr_db"]


def test_swapped_channels_are_recognised_and_grey_ones_cannot_be() -> None:
    image = picture(8)
    with pytest.raises(SwappedColourError, match=r"red and blue look swapped.*BGR"):
        refuse_swapped(image, noisy(image, 0.02)[..., ::-1])
    refuse_swapped(image, noisy(image, 0.02))
    grey = np.repeat(image[..., :1], 3, axis=2)
    refuse_swapped(grey, noisy(grey, 0.05)[..., ::-1])
    # A render that is like nothing proves nothing.
    refuse_swapped(image, picture(9))
    with pytest.raises(ImageShapeError):
        refuse_swapped(image, image[:-1])


def test_eight_bits_and_their_floats_score_the_same() -> None:
    first, second = ((255 * picture(seed)).astype(np.uint8) for seed in (1, 2))
    assert score_image(first, second).values == score_image(first / 255.0, second / 255.0).values


def test_every_metric_names_its_source_and_implementation() -> None:
    for metric in METRICS.values():
        assert metric.definition
        assert metric.implementation.startswith(("evaluator.metrics.", "bridge.media."))
        assert metric.named("raw") == metric.id
    assert METRICS["psnr_db"].named("gain") == "psnr_gain_db"
    assert METRICS["ssim_zero"].named("objects_black") == "ssim_zero_objects_black"
