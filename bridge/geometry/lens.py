"""How a lens bends rays, and the pinhole camera that sees the same without.

Rays have z = 1. Coefficients stand in OpenCV's order, as ROS sends them.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bridge.geometry.camera import Camera

Plane = Float[np.ndarray, "rows columns"]
WIDEST, NARROWEST = 0.5, 4.0
"""Focal length of the pinhole camera in those of the lens. Below, the middle would lose more than
half of its resolution to a rim drawn out long."""
NEAR_RIM = 0.1
"""Of the smaller side: where a lens turns back so near the rim, its corners are cut off."""
GRID = (49, 65)
"""Rows and columns at which a view is tried."""


class LensError(ValueError):
    """A lens that cannot be used; the message says what was found."""


@dataclass(frozen=True)
class Brown:
    """Radial (also rational), tangential and thin-prism distortion of a lens that is no fisheye."""

    coefficients: tuple[float, ...]
    """k1 k2 p1 p2 k3, k4 k5 k6 below the fraction, s1 s2 s3 s4."""

    def bend(self, x: Plane, y: Plane) -> tuple[Plane, Plane]:
        """Where rays arrive at focal length 1; NaN beyond a pole."""
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self.coefficients
        r2 = x * x + y * y
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / np.where(below > 0, below, np.nan)
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
        )


@dataclass(frozen=True)
class KannalaBrandt:
    """A fisheye: the radius is a polynomial of the angle from the axis, equidistant with zeros."""

    coefficients: tuple[float, ...]

    def bend(self, x: Plane, y: Plane) -> tuple[Plane, Plane]:
        """Where rays arrive at focal length 1."""
        k1, k2, k3, k4 = self.coefficients
        r = np.maximum(np.hypot(x, y), 1e-12)
        angle = np.arctan(r)
        a2 = angle * angle
        radial = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / r
        return x * radial, y * radial


Lens = Brown | KannalaBrandt
_MODELS: dict[str, tuple[type[Brown] | type[KannalaBrandt], int]] = {
    "plumb_bob": (Brown, 5),
    "brown_conrady": (Brown, 5),
    "rational_polynomial": (Brown, 8),
    "thin_prism_model": (Brown, 12),
    **dict.fromkeys(
        ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4"), (KannalaBrandt, 4)
    ),
}
"""By the name that ROS or a driver has for it: the model, and how many numbers it has."""
_STRAIGHT = ("", "none", "pinhole")


def lens_of(model: str, coefficients: tuple[float, ...]) -> Lens | None:
    """Return the lens that a camera says it has; None: it bends no line."""
    name = model.lower()
    used = np.trim_zeros(coefficients, "b")
    if not len(used) and (name in _STRAIGHT or name.endswith("brown_conrady")):
        return None
    if name not in _MODELS:
        what = f"lens model {model!r}" if name else f"{len(used)} numbers of a lens without a model"
        raise LensError(f"{what}, which is none of {', '.join(_MODELS)}")
    kind, count = _MODELS[name]
    if len(used) > count or not np.isfinite(used).all():
        text = ", ".join(f"{value:g}" for value in coefficients)
        raise LensError(f"lens model {model} with the numbers {text}, and it has {count}")
    if kind is Brown and not len(used):
        return None
    room = 12 if kind is Brown else count
    return kind((*map(float, used), *([0.0] * (room - len(used)))))


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
