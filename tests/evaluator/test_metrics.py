"""Image and trajectory metrics: laws, and data that has no answer."""

import numpy as np
import pytest

from bridge.geometry.trajectory import PoseTrajectory
from bridge.media.image_quality import ImageShapeError, psnr_db
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import pose_errors


def picture(seed: int = 0, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    image = np.random.default_rng(seed).random((*size, 3))
    image.flags.writeable = False
    return image


def track(p_m: np.ndarray, start_ns: int = 0, step_ns: int = 1_000_000) -> PoseTrajectory:
    stamps = start_ns + step_ns * np.arange(len(p_m), dtype=np.int64)
    return PoseTrajectory(stamps, p_m, np.tile([1.0, 0.0, 0.0, 0.0], (len(p_m), 1)))


def line(offset_m: float = 0.0, num: int = 21) -> np.ndarray:
    p = np.zeros((num, 3))
    p[:, 0] = np.linspace(0, 1, num)
    p[:, 1] = offset_m
    return p


def test_a_constant_offset_has_the_textbook_psnr() -> None:
    image = np.full((16, 16, 3), 0.5)
    assert psnr_db(image, image + 0.1) == pytest.approx(20.0)


def test_a_mask_counts_only_its_pixels() -> None:
    image = picture()
    other = image.copy()
    other[:, 16:] += 0.1
    mask = np.zeros((24, 32), dtype=bool)
    mask[:, 16:] = True
    assert psnr_db(image, other, mask=mask) == pytest.approx(20.0)
    assert psnr_db(image, other) == pytest.approx(20.0 + 10 * np.log10(2))
    with pytest.raises(UndefinedStatisticError, match="no pixel"):
        psnr_db(image, other, mask=np.zeros((24, 32), dtype=bool))


def test_images_of_different_size_are_refused() -> None:
    with pytest.raises(ImageShapeError, match=r"\(24, 32, 3\).*\(24, 30, 3\)"):
        psnr_db(picture(), picture(size=(24, 30)))


def test_a_delay_shows_as_speed_times_delay() -> None:
    # 1 m in 20 steps; one step late is 0.05 m behind at every common instant.
    errors = pose_errors(track(line()), track(line(), start_ns=1_000_000))
    np.testing.assert_allclose(errors.position_m, 0.05, rtol=1e-9)
    assert len(errors.position_m) == 20


def test_motions_that_share_no_instant_are_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="do not overlap"):
        pose_errors(track(line()), track(line(), start_ns=10**12))
