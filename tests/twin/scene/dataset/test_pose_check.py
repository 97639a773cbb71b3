"""Poses in a wrong convention are found by the depth, and the sentence says which would fit."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import textured_room

from bridge.geometry import se3
from twin.scene.dataset.scan_check import BODY_AXES, FLIP_YZ, check_poses
from twin.scene.frames.downscaled import DownscaledDepth, downscaled_depth, thinned_camera

NUM_FRAMES = 10


def thumbs() -> list[DownscaledDepth]:
    return [downscaled_depth(textured_room.frame(k, NUM_FRAMES), 72) for k in range(NUM_FRAMES)]


def reordered(T: np.ndarray, order: list[int]) -> np.ndarray:
    q, p = se3.split(T)
    return se3.transform_from(q[order], p)


WRONG: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "world-to-camera": se3.invert,
    "OpenGL": lambda T: T @ FLIP_YZ,
    "body frame": lambda T: T @ se3.invert(BODY_AXES),
    "w x y z were read as x y z w": lambda T: reordered(T, [3, 0, 1, 2]),
    "x y z w were read as w x y z": lambda T: reordered(T, [1, 2, 3, 0]),
}


def test_right_poses_agree() -> None:
    report = check_poses(thumbs())
    assert report.num_pairs > 3
    assert report.agreement is not None
    assert report.agreement > 0.9
    assert report.better is None
    assert report.remark() == ""


@pytest.mark.parametrize("name", WRONG)
def test_each_wrong_convention_is_named(name: str) -> None:
    spoilt = [replace(t, T_base_depth=WRONG[name](t.T_base_depth)) for t in thumbs()]
    report = check_poses(spoilt)
    assert report.better is not None
    assert name in report.remark()
    assert "%" in report.remark()


def test_poses_that_fit_under_no_convention_are_said_to() -> None:
    rng = np.random.default_rng(1)
    wrong = []
    for thumb in thumbs():
        T = thumb.T_base_depth.copy()
        T[:3, 3] += rng.uniform(-0.2, 0.2, 3)
        wrong.append(replace(thumb, T_base_depth=T))
    report = check_poses(wrong)
    assert report.better is None
    assert "no known convention" in report.remark()


def test_a_camera_that_stands_still_cannot_be_checked() -> None:
    one = thumbs()[0]
    report = check_poses([one] * 5)
    assert report.num_pairs == 0
    assert report.agreement is None
    assert report.remark() == ""


def test_views_of_different_places_are_said_not_to_overlap() -> None:
    away = []
    for index, thumb in enumerate(thumbs()):
        T = thumb.T_base_depth.copy()
        T[0, 3] += 5.0 * index
        depth = thumb.depth_m * np.float32(1 + index % 3)  # so that no pair looks the same
        away.append(replace(thumb, T_base_depth=T, depth_m=depth))
    assert "hardly overlap" in check_poses(away).remark()


def test_a_thinned_camera_looks_through_the_pixels_that_were_kept() -> None:
    camera = textured_room.DEPTH
    rays = camera.rays()
    np.testing.assert_allclose(thinned_camera(camera, 5).rays(), rays[::5, ::5], atol=1e-12)
