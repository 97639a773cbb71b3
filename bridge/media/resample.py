"""Images resampled: each pixel from its place in another image."""

import numpy as np
from jaxtyping import Float, UInt8

ONE = 256
"""Weights are eight-bit fixed point and sum to this: 255 times it still fits into 16 bits."""
TWO_LANES = 0x00FF00FF
HALF = 0x00800080


class Resampling:
    """Resamples images bilinearly; pixels that see outside the image become black.

    Two colours are weighted at once, each in 16 bits of one 32-bit number: a third of the time
    that NumPy needs for bytes.
    """

    def __init__(
        self, u: Float[np.ndarray, "height width"], v: Float[np.ndarray, "height width"]
    ) -> None:
        """Take where each pixel lies in the image that is read [px, centres at whole numbers]."""
        height, width = u.shape
        inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        left = np.clip(np.floor(u), 0, width - 2).astype(np.intp)
        top = np.clip(np.floor(v), 0, height - 2).astype(np.intp)
        corner = (top * width + left).ravel()
        right_part, bottom_part = u - left, v - top
        shares = [
            right_part * (1 - bottom_part),
            (1 - right_part) * bottom_part,
            right_part * bottom_part,
        ]
        weights = [np.where(inside, np.floor(share * ONE), 0.0) for share in shares]
        weights.insert(0, np.where(inside, ONE - sum(weights), 0.0))
        self._shape = (height, width)
        self.weights = np.array(weights, dtype=np.uint32).reshape(4, -1)
        self.places = corner + np.array([[0], [1], [width], [width + 1]])  # what they weigh
        self.nearest = self.places[self.weights.argmax(axis=0), np.arange(corner.size)]

    def apply(self, image_u8: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the image with each pixel taken from its place."""
        pixels = np.zeros((*self._shape, 4), np.uint8)
        pixels[..., :3] = image_u8
        packed = pixels.view(np.uint32).ravel()
        read, work = np.empty((2, packed.size), np.uint32)
        outer, inner = np.full((2, packed.size), HALF, np.uint32)
        for places, weight in zip(self.places, self.weights, strict=True):
            np.take(packed, places, out=read, mode="clip")
            for total, shift in ((outer, 0), (inner, 8)):
                np.right_shift(read, shift, out=work)
                np.bitwise_and(work, TWO_LANES, out=work)
                np.multiply(work, weight, out=work)
                np.add(total, work, out=total)
        np.right_shift(outer, 8, out=outer)
        np.bitwise_and(outer, TWO_LANES, out=outer)
        np.bitwise_and(inner, TWO_LANES << 8, out=inner)
        np.bitwise_or(outer, inner, out=outer)
        return np.array(outer.view(np.uint8).reshape(pixels.shape)[..., :3])
