"""Give the training images of a camera without depth one that is estimated, or refuse them."""

from dataclasses import replace

import numpy as np

from bridge.episode.streams import RgbdFrame
from bridge.terminal import Output
from twin.scene.frames.pairing import UnusableCameraError, name_of
from twin.scene.frames.selection import Chosen, load
from twin.sweep.planes import PosedImage, sweep

MOST_PIXELS = 80_000
"""Larger images are swept at a half, a third and so on of their size."""
LEAST_CONFIRMED = 0.3
"""Share of the pixels: of two captures that come out it is 0.41 and 0.77, of a room whose poses are
off 0.21 (18.8 dB held out), of two with poses shuffled 0.03 and 0.05."""


def estimated_depth(chosen: Chosen, farthest_m: float, output: Output) -> Chosen:
    """Estimate the depth of training images beside which none was recorded.

    Held-out images get none: they are not looked at. A camera whose images agree on no depth is
    left out, and refused where there is no other.
    """
    kept, remarks = [], []
    for choice in chosen.choices:
        if choice.has_depth:
            kept.append(choice)
            continue
        images = {frame.stamp_ns: posed_image(frame) for frame in load(choice, choice.train_ns)}
        with output.progress(f"estimate depth, camera {choice.camera_id}", len(images)) as advance:
            depths_m, confirmed = sweep(list(images.values()), farthest_m, advance)
        name, share = name_of(choice.episode, choice.camera_id), f"{100 * confirmed:.0f} %"
        if confirmed >= LEAST_CONFIRMED:
            kept.append(replace(choice, estimated_m=dict(zip(images, depths_m, strict=True))))
            remarks.append(
                f"{name}: depth estimated from colour, none was measured; other views confirm "
                f"{share} of the pixels"
            )
        else:
            remarks.append(
                f"{name} recorded no depth, and its images do not agree on one: other views "
                f"confirm {share} of the pixels, {100 * LEAST_CONFIRMED:.0f} % are needed. Its "
                "poses are wrong, it hardly moved, or all is of one colour: record depth."
            )
    if not kept:
        raise UnusableCameraError(remarks[0])
    for remark in remarks:
        output.say(remark)
    return replace(chosen, choices=kept, left_out=(*chosen.left_out, *remarks))


def posed_image(frame: RgbdFrame) -> PosedImage:
    """Brightness of a frame at the size that is swept."""
    grey = frame.image_u8.mean(axis=2, dtype=np.float32) / np.float32(255)
    whole = PosedImage(grey=grey, camera=frame.color_camera, T_base_camera=frame.T_base_color)
    return whole.shrunk(int(np.ceil(np.sqrt(grey.size / MOST_PIXELS))))
