"""What is left out first when images come faster than they can be written.

The order is fixed: previews, then the quality of colour, then every other colour image, then every
other depth image. Joints, plans and all other small messages are never shed.
"""

from enum import IntEnum


class Shed(IntEnum):
    """How far shedding has gone; each level includes those before it."""

    NOTHING = 0
    PREVIEWS = 1
    COLOR_QUALITY = 2
    COLOR_RATE = 3
    DEPTH_RATE = 4


BEGINS_AT = (0.0, 0.25, 0.5, 0.7, 0.85)
"""Fill of the camera queue at which each level begins."""
ENDS_BELOW = 0.75
"""A level ends when the fill is below this part of where it began."""
REDUCED_QUALITY = 60
"""JPEG quality from ``COLOR_QUALITY`` on."""


def next_level(level: Shed, fill: float) -> Shed:
    """Return the level that belongs to a fill of 0 to 1, given the level so far."""
    wanted = max(item for item in Shed if fill >= BEGINS_AT[item])
    if wanted < level and fill >= BEGINS_AT[level] * ENDS_BELOW:
        return level
    return wanted


def keep_every(level: Shed, kind: str) -> int:
    """Return n when only every n-th image of a kind (color, depth or "") is to be kept."""
    if kind == "color":
        return {Shed.COLOR_RATE: 2, Shed.DEPTH_RATE: 4}.get(level, 1)
    if kind == "depth":
        return 2 if level >= Shed.DEPTH_RATE else 1
    return 1
