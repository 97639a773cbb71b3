"""A duck, a sloth and a basket: solids and paint in their natural size.

Natural frames: x forwards, z up, the origin somewhere inside; ``catalogue`` centres and scales.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.task.meshes import solids
from bridge.task.meshes.solids import Distances, Points, Solid

Paint = Callable[[Points], Points]
"""Colour (sRGB, 0..1) of points of the surface."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """One shape as drawn: where its surface is, what colour it has, and where to look for it."""

    solid: Solid
    paint: Paint
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    spacing_m: float


def duck_solid(p: Points) -> Distances:
    """A bath duck: body with a flat underside, tail, wings, head and beak."""
    body = solids.ellipsoid(p, (-0.004, 0.0, -0.008), (0.031, 0.0235, 0.0205))
    tail = solids.capsule(p, (-0.026, 0.0, 0.000), (-0.034, 0.0, 0.010), 0.008, 0.004)
    wings = [
        solids.ellipsoid(p, (-0.008, side * 0.0215, -0.004), (0.016, 0.0045, 0.010))
        for side in (-1.0, 1.0)
    ]
    head = solids.ellipsoid(p, (0.016, 0.0, 0.0205), (0.0150, 0.0145, 0.0145))
    beak = solids.ellipsoid(p, (0.0315, 0.0, 0.0170), (0.0085, 0.0085, 0.0038))
    whole = solids.blend_all([body, tail, *wings], 0.006)
    whole = solids.blend(whole, head, 0.012)
    whole = solids.blend(whole, beak, 0.003)
    return solids.cut(whole, p[:, 2] + 0.0245, 0.004)


def duck_paint(p: Points) -> Points:
    """Yellow, darker wings, an orange beak and black eyes with a white spot."""
    colors = np.tile([0.96, 0.80, 0.14], (len(p), 1))
    wing = np.abs(p[:, 1]) > 0.0225
    feather = np.sin(p[:, 0] * 700.0 + p[:, 2] * 350.0) > 0.2
    colors[wing] = [0.90, 0.66, 0.08]
    colors[wing & feather] = [0.80, 0.54, 0.06]
    colors[p[:, 0] > 0.0295] = [0.92, 0.42, 0.08]
    for side in (-1.0, 1.0):
        far = np.linalg.norm(p - np.array([0.0255, side * 0.0090, 0.0255]), axis=1)
        colors[far < 0.0042] = [0.97, 0.97, 0.95]
        colors[far < 0.0031] = [0.05, 0.05, 0.06]
    return colors


def sloth_solid(p: Points) -> Distances:
    """A plush sloth on its belly, limbs spread, with a waist to take it by."""
    chest = solids.ellipsoid(p, (0.027, 0.0, 0.000), (0.024, 0.0260, 0.0225))
    hips = solids.ellipsoid(p, (-0.040, 0.0, 0.000), (0.026, 0.0280, 0.0225))
    waist = solids.capsule(p, (0.027, 0.0, -0.001), (-0.040, 0.0, -0.001), 0.0155, 0.0155)
    head = solids.ellipsoid(p, (0.060, 0.0, 0.0085), (0.0220, 0.0240, 0.0235))
    nose = solids.ellipsoid(p, (0.0815, 0.0, 0.0050), (0.0060, 0.0085, 0.0065))
    limbs = []
    for side in (-1.0, 1.0):
        shoulder, hip = (0.026, side * 0.018, -0.006), (-0.043, side * 0.018, -0.008)
        limbs.append(solids.capsule(p, shoulder, (0.050, side * 0.0415, -0.0115), 0.0120, 0.0100))
        limbs.append(solids.capsule(p, hip, (-0.066, side * 0.0400, -0.0110), 0.0130, 0.0110))
    whole = solids.blend_all([chest, hips, waist, *limbs], 0.010)
    whole = solids.blend(whole, solids.blend(head, nose, 0.005), 0.010)
    return solids.cut(whole, p[:, 2] + 0.0205, 0.004)


def sloth_paint(p: Points) -> Points:
    """Brown fur in strands, a light face with dark patches at the eyes, and dark claws."""
    strand = np.sin(p[:, 0] * 620.0 + 3.0 * np.sin(p[:, 1] * 260.0)) * np.sin(p[:, 1] * 540.0)
    colors = np.array([0.56, 0.43, 0.31]) * (1.0 + 0.13 * strand)[:, None]
    back = np.abs(p[:, 1] - 0.004 * np.sin(p[:, 0] * 130.0)) < 0.005
    colors[back & (p[:, 0] < 0.030) & (p[:, 2] > 0.0)] *= 0.62
    face = np.linalg.norm((p - np.array([0.078, 0.0, 0.008])) / [0.016, 0.019, 0.017], axis=1) < 1
    colors[face] = [0.88, 0.79, 0.64]
    for side in (-1.0, 1.0):
        eye = np.array([0.0775, side * 0.0110, 0.0130])
        patch = np.linalg.norm((p - eye) / [0.009, 0.0065, 0.0055], axis=1) < 1
        colors[patch] = [0.26, 0.18, 0.13]
        pupil = eye + np.array([0.0020, 0.0, 0.0010])
        colors[np.linalg.norm(p - pupil, axis=1) < 0.0030] = 0.03
    tip = np.linalg.norm(p - np.array([0.0870, 0.0, 0.0075]), axis=1) < 0.0052
    colors[tip] = [0.10, 0.07, 0.06]
    reach = np.abs(p[:, 1]) > 0.0440
    comb = np.abs(((p[:, 0] * 260.0) % 1.0) - 0.5) < 0.32
    colors[reach & comb] = [0.20, 0.16, 0.13]
    return np.clip(colors, 0.0, 1.0)


DESIGNS: dict[str, Design] = {
    "duck": Design(
        solid=duck_solid,
        paint=duck_paint,
        low_m=(-0.046, -0.033, -0.034),
        high_m=(0.048, 0.033, 0.044),
        spacing_m=0.0030,
    ),
    "sloth": Design(
        solid=sloth_solid,
        paint=sloth_paint,
        low_m=(-0.088, -0.062, -0.032),
        high_m=(0.100, 0.062, 0.044),
        spacing_m=0.0042,
    ),
}


# Frame: origin under the middle of the floor, z up, as for an open box.

CORNER_M = 0.035
"""Outer radius of the vertical edges."""
RIM_M = 0.0055
RIM_OVERLAP_M, BLEND_M = 0.004, 0.001
HANDLE_RADIUS_M = 0.030
HANDLE_M = 0.0055
CORNER_PARTS = 3
HANDLE_PARTS = 5
SPACING_M = 0.0045
WEAVE_M = (0.022, 0.013)
"""Width and height of one strand of the weave."""


@dataclass(frozen=True, kw_only=True)
class BoxPart:
    """One solid box of something that is not one box."""

    centre_m: Float[np.ndarray, "3"]
    size_m: Float[np.ndarray, "3"]
    q_wxyz: Float[np.ndarray, "4"]


def basket_design(inner_m: tuple[float, float, float], wall_m: float) -> Design:
    """Draw a basket around a cavity."""
    half_x, half_y, top = inner_m[0] / 2 + wall_m, inner_m[1] / 2 + wall_m, inner_m[2] + wall_m
    middle = half_x - wall_m / 2

    def solid(p: Points) -> Distances:
        shell = solids.rounded_column(p, half_x, half_y, CORNER_M, 0.0, top)
        cavity = solids.rounded_column(
            p, half_x - wall_m, half_y - wall_m, CORNER_M - wall_m, wall_m, top + 0.1
        )
        shell = solids.cut(shell, cavity, 0.002)
        around = solids.outline(p, half_x - wall_m / 2, half_y - wall_m / 2, CORNER_M - wall_m / 2)
        rim = np.hypot(around, p[:, 2] - top) - RIM_M
        handles = [
            solids.ring(p, (side * middle, 0.0, top), 0, HANDLE_RADIUS_M, HANDLE_M)
            for side in (-1.0, 1.0)
        ]
        # Only the upper half of each ring stands out of the rim.
        handle = np.maximum(np.minimum(*handles), top - RIM_M / 2 - p[:, 2])
        return solids.blend_all([shell, rim, handle], 0.003)

    def paint(p: Points) -> Points:
        return _weave(p, top)

    reach = 3 * SPACING_M
    return Design(
        solid=solid,
        paint=paint,
        low_m=(-half_x - RIM_M - reach, -half_y - RIM_M - reach, -reach),
        high_m=(
            half_x + RIM_M + reach,
            half_y + RIM_M + reach,
            top + HANDLE_RADIUS_M + HANDLE_M + reach,
        ),
        spacing_m=SPACING_M,
    )


def _weave(p: Points, top: float) -> Points:
    """Strands that go over and under each other; rim and handles are darker and wound."""
    around = np.where(np.abs(p[:, 0]) / 1.25 > np.abs(p[:, 1]), p[:, 1], p[:, 0])
    column = np.floor(around / WEAVE_M[0])
    row = np.floor(p[:, 2] / WEAVE_M[1])
    over = (column + row) % 2 == 0
    colors = np.where(over[:, None], [0.80, 0.62, 0.38], [0.66, 0.47, 0.26])
    edge = np.minimum(around % WEAVE_M[0], WEAVE_M[0] - around % WEAVE_M[0])
    colors[edge < 0.0014] = [0.45, 0.31, 0.17]
    high = p[:, 2] > top - RIM_M
    wound = np.sin((p[:, 0] + p[:, 1] + p[:, 2]) * 420.0) > 0.0
    colors[high] = [0.52, 0.34, 0.18]
    colors[high & wound] = [0.40, 0.25, 0.13]
    return colors


def basket_parts(inner_m: tuple[float, float, float], wall_m: float) -> list[BoxPart]:
    """Boxes the basket collides with: floor, walls, round corners, handles.

    The walls' inner faces are those of the cavity, so that what the predicate calls inside is free.
    """
    x, y = inner_m[0] / 2, inner_m[1] / 2
    top = inner_m[2] + wall_m
    straight = np.eye(1, 4)[0]
    parts = [
        BoxPart(
            centre_m=np.array([0.0, 0.0, wall_m / 2]),
            size_m=np.array([2 * x + 2 * wall_m, 2 * y + 2 * wall_m, wall_m]),
            q_wxyz=straight,
        )
    ]
    bend = CORNER_M - wall_m
    for axis, reach, along in ((0, x, y), (1, y, x)):
        for side in (-1.0, 1.0):
            centre, size = np.zeros(3), np.zeros(3)
            centre[axis], centre[2] = side * (reach + wall_m / 2), top / 2
            size[axis], size[1 - axis], size[2] = wall_m, 2 * (along - bend), top
            parts.append(BoxPart(centre_m=centre, size_m=size, q_wxyz=straight))
    parts += _corner_parts(x - bend, y - bend, bend + wall_m / 2, wall_m, top)
    return parts + _handle_parts(x + wall_m / 2, top)


def basket_rim_parts(inner_m: tuple[float, float, float], wall_m: float) -> list[BoxPart]:
    """Boxes around the bead on the walls, which a basket has beyond what it collides with."""
    top = inner_m[2] + wall_m
    walls = (part for part in basket_parts(inner_m, wall_m)[1:] if part.centre_m[2] == top / 2)
    parts = []
    for part in walls:
        size = part.size_m + RIM_OVERLAP_M
        size[[int(np.argmin(part.size_m[:2])), 2]] = 2 * RIM_M + BLEND_M
        centre = np.array([*part.centre_m[:2], top])
        parts.append(BoxPart(centre_m=centre, size_m=size, q_wxyz=part.q_wxyz))
    return parts


def _corner_parts(x: float, y: float, radius: float, wall_m: float, top: float) -> list[BoxPart]:
    """Wall pieces along the four quarter circles around (+-x, +-y)."""
    parts = []
    step = np.pi / 2 / CORNER_PARTS
    chord = 2 * (radius + wall_m / 2) * np.sin(step / 2)
    for sign_x, sign_y in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        first = np.arctan2(sign_y, sign_x) - np.pi / 4
        for k in range(CORNER_PARTS):
            angle = first + (k + 0.5) * step
            centre = np.array([sign_x * x, sign_y * y, top / 2])
            centre[:2] += radius * np.array([np.cos(angle), np.sin(angle)])
            parts.append(
                BoxPart(
                    centre_m=centre,
                    size_m=np.array([wall_m, chord, top]),
                    q_wxyz=np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]),
                )
            )
    return parts


def _handle_parts(x: float, top: float) -> list[BoxPart]:
    """Straight pieces of the two half rings."""
    parts = []
    step = np.pi / HANDLE_PARTS
    length = 2 * (HANDLE_RADIUS_M + HANDLE_M) * np.sin(step / 2)
    for side in (-1.0, 1.0):
        for k in range(HANDLE_PARTS):
            angle = (k + 0.5) * step
            centre = np.array(
                [
                    side * x,
                    HANDLE_RADIUS_M * np.cos(angle),
                    top + HANDLE_RADIUS_M * np.sin(angle),
                ]
            )
            parts.append(
                BoxPart(
                    centre_m=centre,
                    size_m=np.array([2 * HANDLE_M, 2 * HANDLE_M, length]),
                    q_wxyz=np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]),
                )
            )
    return parts
