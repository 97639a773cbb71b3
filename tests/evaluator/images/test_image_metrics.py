"""Image metrics: laws they must keep, and images that have no answer."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.media.image_quality import PADDINGS, ImageShapeError, ssim_maps
from evaluator.metrics.image import METRICS, RAW, SwappedColourError, refuse_swapped, score_pair

PLAIN_METRICS = [metric for metric in METRICS.values() if not metric.id.startswith("lpips")]


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
    assert ssim_maps(image, image).mean(padding) == pytest.approx(1.0)


def test_every_metric_is_worse_with_more_noise() -> None:
    image = picture(1, (176, 180))
    scores = [score_pair(image, noisy(image, s))[RAW].values for s in (0.01, 0.05, 0.2)]
    for metric in PLAIN_METRICS:
        values = [values[metric.id] for values in scores]
        assert values == sorted(values, reverse=metric.higher_is_better), metric.id


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.01, 0.3))
def test_every_metric_is_symmetric(seed: int, scale: float) -> None:
    image = picture(seed)
    other = noisy(image, scale)
    there, back = (score_pair(a, b)[RAW].values for a, b in ((image, other), (other, image)))
    assert there == pytest.approx(back, abs=1e-12)


def test_a_mirrored_or_turned_pair_keeps_its_scores() -> None:
    image = picture(2)
    other = noisy(image, 0.1)
    turned = [np.rot90(i) for i in (image, other)]
    for padding in PADDINGS:
        expected = ssim_maps(image, other).mean(padding)
        assert ssim_maps(*turned).mean(padding) == pytest.approx(expected, abs=1e-12)


def test_an_exposure_offset_costs_psnr_and_hardly_ssim() -> None:
    image = picture(4)
    raw, gain = (score_pair(image, 0.9 * image)[how].values for how in ("raw", "gain"))
    assert raw["psnr_db"] < 26
    assert raw["ssim"] > 0.98
    assert gain.get("psnr_db", 400.0) > 100  # rounding may even leave nothing


def test_pixels_of_a_mask_are_scored_alone() -> None:
    image = picture(5, (176, 180))
    other = noisy(image, 0.1)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[60:90, 60:90] = True
    scores = score_pair(image, other, masks={"cup": mask})
    whole, pixels = scores[RAW].values, scores["cup"].values
    assert pixels["psnr_db"] == pytest.approx(whole["psnr_db"], abs=1.0)


def test_metrics_alter_no_image() -> None:
    image = picture(7, (176, 176))
    other = noisy(image, 0.1)
    before = other.copy()
    other.flags.writeable = False
    score_pair(image, other)
    np.testing.assert_array_equal(other, before)


def test_too_small_images_say_what_they_lack() -> None:
    small = picture(0, (8, 8))
    score = score_pair(small, noisy(small, 0.1))[RAW]
    assert set(score.values) == {"psnr_db"}
    assert "window" in score.reasons["ssim_zero"]


def test_identical_images_have_no_psnr() -> None:
    image = picture()
    score = score_pair(image, image)[RAW]
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
    assert score_pair(first, second) == score_pair(first / 255.0, second / 255.0)


def test_every_metric_is_named_by_its_variant() -> None:
    for metric in METRICS.values():
        assert metric.definition
        assert metric.named("raw") == metric.id
    assert METRICS["psnr_db"].named("gain") == "psnr_gain_db"
    assert METRICS["ssim_zero"].named("objects") == "ssim_zero_objects"
