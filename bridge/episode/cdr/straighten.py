"""Images recorded through a lens, as a pinhole camera of the same size would have taken them."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8, UInt16

from bridge.geometry.camera import Camera
from bridge.geometry.lens import Lens, LensError, Plane, lens_of
from bridge.media.color import UnreadableImageError
from bridge.media.resample import ONE, Resampling

Pixels = TypeVar("Pixels", bound=np.ndarray)
WIDEST, NARROWEST = 0.5, 4.0
"""Focal length of the pinhole camera in those of the lens. Below, the middle would lose more than
half of its resolution to a rim drawn out long."""
NEAR_RIM = 0.1
"""Of the smaller side: where a lens turns back so near the rim, its corners are cut off."""
SAME = 0.03
"""Neighbours whose depths differ by no more than this share lie on one surface."""
GRID = (49, 65)
"""Rows and columns at which a view is tried."""


def landing(
    lens: Lens, recorded: Camera, camera: Camera, u: Plane, v: Plane
) -> tuple[Plane, Plane]:
    """Where in the recorded image lies what a pinhole camera sees at u, v [px, centres at +0.5]."""
    x, y = lens.bend((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    return x * recorded.fx + recorded.cx, y * recorded.fy + recorded.cy


def pinhole_within(lens: Lens, recorded: Camera) -> tuple[Camera, float]:
    """The widest pinhole camera of that size, axis and pixel shape that sees recorded pixels only.

    And the share of the recorded view that it does not see.

    Raises:
        LensError: Where the lens turns back inside the image, so that two rays meet in a pixel.
    """
    if _room(lens, recorded, WIDEST) >= 0:
        factor = WIDEST
    else:
        wide, factor = WIDEST, NARROWEST
        for _ in range(40):
            middle = (wide + factor) / 2
            wide, factor = (
                (wide, middle) if _room(lens, recorded, middle) >= 0 else (middle, factor)
            )
        least = min(recorded.width, recorded.height)
        if not 0 <= _room(lens, recorded, factor) < max(1, NEAR_RIM * least):
            raise LensError("a lens that turns back inside the image, or leaves none of it")
    camera = replace(recorded, fx=recorded.fx * factor, fy=recorded.fy * factor)
    u, v = landing(lens, recorded, camera, *_grid(camera))
    rim_u, rim_v = (np.concatenate([p[0], p[1:, -1], p[-1, -2::-1], p[-2:0:-1, 0]]) for p in (u, v))
    area = 0.5 * abs(np.sum(rim_u * np.roll(rim_v, 1) - rim_v * np.roll(rim_u, 1)))
    return camera, max(0.0, 1 - float(area) / ((recorded.width - 1) * (recorded.height - 1)))


def _grid(camera: Camera) -> tuple[Plane, Plane]:
    """Some pixels of a view, its rim among them."""
    rows, columns = GRID
    sides = (camera.width, columns), (camera.height, rows)
    u, v = np.meshgrid(*(np.linspace(0.5, side - 0.5, count) for side, count in sides))
    return u, v


@np.errstate(all="ignore")  # what is no number is outside of every image
def _room(lens: Lens, recorded: Camera, factor: float) -> float:
    """Pixels left between a view and the rim of the recorded image; -1: it folds or sticks out."""
    camera = replace(recorded, fx=recorded.fx * factor, fy=recorded.fy * factor)
    u, v = landing(lens, recorded, camera, *_grid(camera))
    (down_u, right_u), (down_v, right_v) = np.gradient(u), np.gradient(v)
    room = min(
        (u - 0.5).min(), (v - 0.5).min(),
        (recorded.width - 0.5 - u).min(), (recorded.height - 0.5 - v).min(),
    )  # fmt: skip
    folds = not (right_u * down_v - down_u * right_v > 0).all()
    return -1.0 if folds or not room >= 0 else float(room)


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

    def depth(self, depth_mm: UInt16[np.ndarray, "height width"]) -> UInt16[np.ndarray, "h w"]:
        """Straighten depth: between pixels of one surface its inverse is linear; else the nearest.

        Surfaces are never mixed.
        """
        taps, recorded = self._bilinear, self._of_this_size(depth_mm).ravel()
        around, nearest = recorded[taps.places], recorded[taps.nearest]
        one_surface = (around.min(axis=0) > 0) & (np.ptp(around, axis=0) <= SAME * nearest)
        between = ONE / (taps.weights / np.maximum(around, 1)).sum(axis=0)
        found = np.where(one_surface, np.rint(between), nearest)
        return np.asarray(found.reshape(depth_mm.shape), dtype=np.uint16)

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
