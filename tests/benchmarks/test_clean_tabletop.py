"""The generator that the fit is measured on: fixed, and exact in its geometry."""

import sys
from pathlib import Path

import numpy as np
import pytest

from bridge.geometry import se3

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))


@pytest.mark.slow
def test_the_tabletop_repeats_and_its_depth_is_exact() -> None:
    pytest.importorskip("pybullet")
    from splat import clean_tabletop

    images, depths = clean_tabletop.draw((3, 40))
    again, _ = clean_tabletop.draw((3,))
    np.testing.assert_array_equal(again[0], images[0])
    assert images.std() > 30
    for index, image, depth_m in zip((3, 40), images, depths, strict=True):
        frame = clean_tabletop.frame_of(index, image, depth_m)
        offset_px, left_m = clean_tabletop.measured_offset(frame)
        np.testing.assert_allclose(offset_px, 0.0, atol=0.05)
        assert left_m < 1e-3
        points = se3.apply(frame.T_base_depth, frame.depth_camera.unproject(depth_m))
        on_table = np.abs(points[..., 2] - clean_tabletop.TABLE_M) < 2e-3
        assert on_table.mean() > 0.25
        assert depth_m.max() < 5.0


@pytest.mark.slow
def test_areas_are_averaged_around_the_points_that_the_renderer_looks_at() -> None:
    pytest.importorskip("pybullet")
    from splat import clean_tabletop

    image, fine = (clean_tabletop.draw((3,), finer)[0][0] for finer in (1, clean_tabletop.FINER))
    only_the_point = np.eye(9)[4]
    same = (clean_tabletop.area_means(fine, only_the_point) == image).all(axis=-1)
    assert same.mean() > 0.9999  # a point on an edge may fall to either side


def test_an_area_s_weights_add_up_and_lie_evenly_about_its_point() -> None:
    from splat import clean_tabletop

    x_px = np.arange(40) / clean_tabletop.FINER
    ramp = np.broadcast_to((20 * x_px)[None, :, None], (40, 40, 3)).astype(np.uint8)
    for weights in (clean_tabletop.box_weights(), clean_tabletop.gaussian_weights()):
        assert weights.sum() == pytest.approx(1)
        means = clean_tabletop.area_means(ramp, weights)
        inside = slice(2, -2)
        np.testing.assert_array_equal(
            means[inside, inside],
            ramp[3 :: clean_tabletop.FINER, :: clean_tabletop.FINER][inside, inside],
        )
