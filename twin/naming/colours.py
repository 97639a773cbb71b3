"""Colours as people see and name them: CIE Lab and a dozen names."""

import colorsys
from itertools import product

import numpy as np
from jaxtyping import Float

from bridge.media.color import linear_from_srgb

_XYZ_FROM_RGB = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
"""Linear sRGB to XYZ, IEC 61966-2-1."""
_WHITE = _XYZ_FROM_RGB.sum(axis=1)
GREY_CHROMA = 11.0
"""Less colourful is black, grey or white."""
GREYS = ("black", "grey", "white")
VIVID, COLOURFUL, ONE_HUE = 1.5, 0.25, 0.7
"""How far above ``GREY_CHROMA`` a thing shows its colour, on which share of it at least, and the
mean of unit vectors along its hues from which they are one."""
LIGHTNESS_WEIGHT = 0.3
"""Shading changes lightness, not the ratios of a and b to it."""
DULL_CHROMA = 42.0
"""Warm colours below this are brown or beige."""
_HUES = (
    (48.0, "red"),
    (80.0, "orange"),
    (115.0, "yellow"),
    (182.0, "green"),
    (228.0, "cyan"),
    (309.0, "blue"),
    (348.0, "purple"),
    (360.0, "red"),
)
"""Upper end of each name's range of Lab hue [degrees]."""
COLOUR_NAMES = (
    "black",
    "grey",
    "white",
    "brown",
    "beige",
    "pink",
    *dict.fromkeys(name for _, name in _HUES),
)


def lab_from_srgb(
    color: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Turn sRGB (0..1, clipped) into CIE L*a*b* with the D65 white (CIE 15:2004).

    Range: L 0..100; a difference of 2 is just visible.
    """
    srgb = np.clip(np.asarray(color, dtype=np.float64), 0.0, 1.0)
    ratio = linear_from_srgb(srgb) @ _XYZ_FROM_RGB.T / _WHITE
    knee = 6.0 / 29.0
    f = np.where(ratio > knee**3, np.cbrt(ratio), ratio / (3 * knee**2) + 4.0 / 29.0)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def colour_name(color: Float[np.ndarray, "3"]) -> str:
    """Name an sRGB colour (0..1) with one of ``COLOUR_NAMES``."""
    lightness, a, b = lab_from_srgb(color)
    chroma = float(np.hypot(a, b))
    hue = float(np.degrees(np.arctan2(b, a))) % 360.0
    if chroma < GREY_CHROMA:
        return "black" if lightness < 25 else "white" if lightness > 82 else "grey"
    name = next(name for end, name in _HUES if hue <= end)
    if name in ("red", "purple") and lightness > 65 and chroma < 60:
        return "pink"
    if name == "orange" or (name in ("red", "yellow") and 30 < hue < 100 and chroma < DULL_CHROMA):
        if chroma < DULL_CHROMA and lightness > 62:
            return "beige"
        if lightness < 52 or chroma < DULL_CHROMA:
            return "brown"
    return name


def main_colour(colors: Float[np.ndarray, "num_colours 3"]) -> Float[np.ndarray, "3"]:
    """Of a thing: the middle of its colourful part, not of the frame around a green seat.

    The middle of all where less than ``COLOURFUL`` of it is colourful, or that is of many hues.
    """
    ab = lab_from_srgb(colors)[:, 1:]
    chroma = np.linalg.norm(ab, axis=1)
    part = chroma > VIVID * GREY_CHROMA
    if part.mean() >= COLOURFUL:
        hue = np.linalg.norm((ab[part] / chroma[part, None]).mean(axis=0))
        colors = colors[part] if hue > ONE_HUE else colors
    return np.asarray(np.median(colors, axis=0), dtype=np.float64)


def near_colours(color_srgb: tuple[int, int, int]) -> tuple[set[str], set[str]]:
    """Names of a colour in other light, and in light of another colour, or faded, besides.

    A white cup in shade is grey.
    """
    if colour_name(np.array(color_srgb) / 255) in GREYS:
        values = np.clip(max(color_srgb) / 255 * np.array([0.75, 1.0, 1.4]), 0.0, 1.0)
        names = {colour_name(np.full(3, value)) for value in values}
        return names, names
    hue, saturation, value = colorsys.rgb_to_hsv(*(channel / 255 for channel in color_srgb))
    near: dict[bool, set[str]] = {True: set(), False: set()}
    for h, s, v in product((-0.04, 0.0, 0.04), (0.75, 1.0, 1.3), (0.75, 1.0, 1.4)):
        shade = colorsys.hsv_to_rgb((hue + h) % 1.0, min(saturation * s, 1), min(value * v, 1))
        near[h == 0 and s == 1].add(colour_name(np.array(shade)))
    return near[True], near[True] | near[False]


def without_shading(lab: Float[np.ndarray, "num_colours 3"]) -> Float[np.ndarray, "num_colours 3"]:
    """Lab as it would be at lightness 50, and a little of the lightness itself.

    Light that is s times as strong multiplies a, b and L + 16 by the cube root of s.
    """
    strength = np.maximum(lab[:, :1] + 16.0, 25.0) / 66.0
    return np.concatenate([LIGHTNESS_WEIGHT * lab[:, :1], lab[:, 1:] / strength], axis=1)
