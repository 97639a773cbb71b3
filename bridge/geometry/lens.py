"""How a lens bends rays.

Rays have z = 1. Coefficients stand in OpenCV's order, as ROS sends them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Plane = Float[np.ndarray, "rows columns"]


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
