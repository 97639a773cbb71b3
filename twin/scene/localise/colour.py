"""How much a pixel has an object's colour, whatever the shading.

Diffuse shading scales linear light by one factor, so the share of each channel in the sum is a
property of the surface alone. The likeness is 1 on the object's colour, 0 on grey.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

_SRGB = np.arange(256) / 255.0
_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4).astype(
    np.float32
)


@dataclass(frozen=True, kw_only=True)
class ColourConfig:
    """Which pixels have an object's colour."""

    max_hue_difference_rad: float = 0.4
    """Between a pixel's hue and the object's, around the grey axis."""
    min_luminance: float = 0.003
    """Darker pixels, in linear light of 0 to 1, have no dependable hue."""


def linear_from_srgb(
    image_u8: UInt8[np.ndarray, "height width 3"],
) -> Float[np.ndarray, "height width 3"]:
    """Undo the sRGB curve (IEC 61966-2-1): linear light of 0 to 1."""
    return np.asarray(_LINEAR[image_u8])


def likeness(
    image_linear: Float[np.ndarray, "*batch 3"],
    color_srgb: tuple[int, int, int],
    config: ColourConfig,
) -> Float[np.ndarray, "*batch"]:
    """Tell how much each pixel has a colour: 1 the object's chroma, 0 grey or another hue.

    An edge pixel that mixes object and grey lies between, which places edges between pixels.

    Range: 0 and up, about 1 on the object.
    """
    total = image_linear.sum(axis=-1)
    dark = total < 3 * config.min_luminance
    chroma = image_linear / np.where(dark, 1.0, total)[..., None] - 1 / 3
    wanted = _LINEAR[np.array(color_srgb)]
    wanted = wanted / wanted.sum() - 1 / 3
    strength = float(np.linalg.norm(wanted))
    along = chroma @ (wanted / strength)
    across = np.sqrt(np.maximum((chroma * chroma).sum(axis=-1) - along * along, 0.0))
    other_hue = across > along * np.tan(config.max_hue_difference_rad)
    return np.where(dark | other_hue | (along <= 0), 0.0, along / strength)
