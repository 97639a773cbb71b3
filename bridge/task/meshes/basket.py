"""A basket: woven walls with a rim bead, two handles over the short sides, and its solid parts.

Frame: origin under the middle of the floor, z up, as for an open box.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.task.meshes import solids
from bridge.task.meshes.toys import Design

CORNER_M = 0.035
"""Outer radius of the vertical edges."""
RIM_M = 0.0055
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
    """Draw a basket around a cavity.

    Args:
        inner_m: Extents of the cavity [m].
        wall_m: Thickness of walls and floor [m].
    """
    half_x, half_y, top = inner_m[0] / 2 + wall_m, inner_m[1] / 2 + wall_m, inner_m[2] + wall_m
    middle = half_x - wall_m / 2

    def solid(p: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, " num_points"]:
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

    def paint(p: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, "num_points 3"]:
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


def _weave(p: Float[np.ndarray, "num_points 3"], top: float) -> Float[np.ndarray, "num_points 3"]:
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
