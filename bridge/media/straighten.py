"""Takes the distortion of a lens out of images: from each pixel to where its ray was recorded."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeVar, cast

import numpy as np
from jaxtyping import Float, UInt8

from bridge.geometry.camera import Camera
from bridge.geometry.lens import Lens, LensError, landing, lens_of, pinhole_within
from bridge.media.color import UnreadableImageError

Pixels = TypeVar("Pixels", bound=np.ndarray)
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
        self._taps = [
            (corner + step, weight.astype(np.uint32).ravel())
            for step, weight in zip((0, 1, width, width + 1), weights, strict=True)
        ]

    def apply(self, image_u8: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the image with each pixel taken from its place."""
        pixels = np.zeros((*self._shape, 4), np.uint8)
        pixels[..., :3] = image_u8
        packed = pixels.view(np.uint32).ravel()
        read, work = np.empty((2, packed.size), np.uint32)
        outer, inner = np.full((2, packed.size), HALF, np.uint32)
        for places, weight in self._taps:
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


@dataclass(frozen=True, kw_only=True)
class Straightening:
    """From the images behind one lens to those of a pinhole camera of the same size."""

    lens: Lens
    recorded: Camera
    """Focal length and centre as they go with the lens."""
    camera: Camera
    """The pinhole camera."""
    cut: float
    """Share of the recorded view that it does not see."""

    @property
    def said(self) -> str:
        """What was done, in words."""
        return f"its lens was straightened, {self.cut:.1%} of its view cut off"

    def color(self, image_u8: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Straighten a colour image, bilinearly."""
        return self._bilinear.apply(self._of_this_size(image_u8))

    def depth(self, values: Pixels) -> Pixels:
        """Straighten depth or a mask by nearest neighbour: values are never mixed."""
        return cast(Pixels, self._of_this_size(values)[self._nearest])

    def _of_this_size(self, image: Pixels) -> Pixels:
        if image.shape[:2] != (self.recorded.height, self.recorded.width):
            size = f"{image.shape[1]} x {image.shape[0]} pixels"
            expected = f"{self.recorded.width} x {self.recorded.height} as its camera info says"
            raise UnreadableImageError(found=size, expected=expected)
        return image

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        u, v = np.meshgrid(np.arange(self.camera.width) + 0.5, np.arange(self.camera.height) + 0.5)
        u, v = map(np.nan_to_num, landing(self.lens, self.recorded, self.camera, u, v))
        width, height = self.recorded.width, self.recorded.height
        return np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)

    @cached_property
    def _bilinear(self) -> Resampling:
        return Resampling(*self._places)

    @cached_property
    def _nearest(self) -> tuple[np.ndarray, np.ndarray]:
        u, v = (np.rint(place).astype(np.int32) for place in self._places)
        return v, u


@lru_cache(maxsize=32)
def straightening(
    model: str, coefficients: tuple[float, ...], recorded: Camera
) -> Straightening | LensError | None:
    """Return what straightens the images of a camera, or why nothing can; None: they are straight.

    One for each camera and size, and so are its maps.
    """
    try:
        lens = lens_of(model, coefficients)
        if lens is None:
            return None
        camera, cut = pinhole_within(lens, recorded)
    except LensError as error:
        return error
    return Straightening(lens=lens, recorded=recorded, camera=camera, cut=cut)
