"""Training images at half and at full size."""

from dataclasses import replace

import numpy as np
import textured_room

from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view

LIMITS = DepthLimits(max_depth_m=5.0, flying_fraction=0.1)


def test_half_an_odd_image_keeps_every_pixel_in_its_place() -> None:
    """A block of 2 x 2 pixels is one pixel of the half-size camera, also at the far edge."""
    item = textured_room.frame(1, 4)
    odd = replace(
        item,
        image_u8=item.image_u8[:47, :63],
        color_camera=replace(item.color_camera, width=63, height=47),
    )
    view = training_view(FrameSurface(odd, LIMITS))
    camera = view.half.camera
    assert (camera.width, camera.height) == (32, 24)
    assert view.half.planes_u8.shape == (3, 24, 32)
    p_camera = np.array([[0.3, 0.2, 1.0]])
    np.testing.assert_allclose(
        camera.project(p_camera)[0] * 2, odd.color_camera.project(p_camera)[0], rtol=1e-12
    )
