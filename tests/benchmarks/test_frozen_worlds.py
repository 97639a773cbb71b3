"""What is measured on is fixed: the generated tabletop is exact."""

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
