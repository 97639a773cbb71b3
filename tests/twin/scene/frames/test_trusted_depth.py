"""Which depth measurements are trusted: from which jump on a pixel flies, and both its sides."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from twin.scene.frames.rgbd import DepthLimits, trusted_depth_mask


@given(
    st.floats(0.01, 0.2),
    st.floats(0.3, 2.0),
    st.floats(0.0, 3.0).filter(lambda share: abs(share - 1) > 1e-3),
    st.booleans(),
    st.booleans(),
)
def test_a_pixel_flies_from_the_stated_share_on_in_every_direction(
    fraction: float, near_m: float, share: float, is_row: bool, is_falling: bool
) -> None:
    """The nearer depth times the share decides; both neighbours of a jump are left out."""
    depth = np.full((6, 8), near_m)
    depth[:, 4:] = near_m * (1 + share * fraction)
    depth = depth[:, ::-1] if is_falling else depth
    depth = depth.T if is_row else depth
    limits = DepthLimits(max_depth_m=10.0, flying_fraction=fraction)
    trusted = trusted_depth_mask(np.ascontiguousarray(depth), limits)
    trusted = trusted.T if is_row else trusted
    expected = np.ones((6, 8), dtype=bool)
    if share > 1:
        expected[:, 3:5] = False
    np.testing.assert_array_equal(trusted, expected)
