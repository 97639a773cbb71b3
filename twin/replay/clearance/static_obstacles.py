"""What never moves: the table, the panels of containers, the robot's own foot."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import coal
import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.geometry.mesh import box_corners
from twin.replay.clearance.bodies import TABLE, PanelBox, Solid, half_space_solid, solid_of
from twin.robot.collision import RobotHulls
from twin.scene.shape.sdf import SdfGrid, distances_of_solid
from twin.scene.shape.static import OBJECT_MARGIN_VOXELS, StaticSdf

# The static scene without what has a name: the table, the containers, the robot's own foot.
# A scene's grid shows the table and, where one was not recognised, a container as well. Those are
# bodies with exact shapes here, so what the grid shows within 1.5 voxels of them is taken out and
# distances are made anew; otherwise every allowed contact with the table would be a forbidden one
# with the "scene". A low thing on the table vanishes with it: 12 mm at the usual voxel of 8 mm.

_AROUND_M = 0.15
"""How far around a container distances are made anew; further out the old ones stay, which are
too small if anything."""


@dataclass(frozen=True, kw_only=True)
class Foot:
    """The upright cylinder about the base's z axis that holds the links that stay there."""

    radius_m: float
    top_m: float


def unmodelled_obstacles(
    static: StaticSdf, table_height_m: float, foot: Foot | None, panels: Sequence[PanelBox]
) -> SdfGrid | None:
    """Take table, foot and containers out of a scene's observed grid; None: nothing is left.

    What nobody saw counts as free, as in the observed grid, and what lies beyond the grid too.
    """
    grid = _cleared(static, table_height_m, foot)
    return None if grid is None else _without_panels(grid, panels)


@lru_cache(maxsize=1)
def _cleared(static: StaticSdf, table_height_m: float, foot: Foot | None) -> SdfGrid | None:
    """Without table and foot; replays of a run share it."""
    grid = static.observed
    solid = grid.values_m < 0
    margin = OBJECT_MARGIN_VOXELS * grid.voxel_m
    x, y, z = (
        grid.origin_m[axis] + grid.voxel_m * np.arange(n) for axis, n in enumerate(solid.shape)
    )
    solid[:, :, z <= table_height_m + margin] = False
    if foot is not None:
        near = np.hypot(x[:, None], y[None, :]) <= foot.radius_m + margin
        low = z <= foot.top_m + margin
        solid &= ~(near[:, :, None] & low[None, None, :])
    if not solid.any():
        return None
    values = distances_of_solid(solid, grid.voxel_m)
    return replace(grid, values_m=values, closed=True)


def _without_panels(grid: SdfGrid, panels: Sequence[PanelBox]) -> SdfGrid | None:
    solid = grid.values_m < 0
    margin = OBJECT_MARGIN_VOXELS * grid.voxel_m
    taken = np.zeros_like(solid)
    for T, extents in panels:
        window = _window(grid, T, extents, margin)
        cells = np.argwhere(solid[window])
        if len(cells):
            start = np.array([part.start for part in window])
            p = se3.apply(se3.invert(T), grid.origin_m + (cells + start) * grid.voxel_m)
            outside = np.maximum(np.abs(p) - extents / 2, 0.0)
            near = cells[np.linalg.norm(outside, axis=1) <= margin] + start
            taken[tuple(near.T)] = True
    if not taken.any():
        return grid
    solid &= ~taken
    if not solid.any():
        return None
    cells = np.argwhere(taken)
    around = int(np.ceil(_AROUND_M / grid.voxel_m))
    low = np.maximum(cells.min(axis=0) - around, 0)
    high = np.minimum(cells.max(axis=0) + around + 1, solid.shape)
    part = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    # Solid may lie right outside of the part, where it does not end with the grid.
    rim = [(int(a > 0), int(b < size)) for a, b, size in zip(low, high, solid.shape, strict=True)]
    inner = tuple(slice(a, -b or None) for a, b in rim)
    new = distances_of_solid(np.pad(solid[part], rim, constant_values=True), grid.voxel_m)[inner]
    values = grid.values_m.copy()
    values[part] = np.maximum(values[part], new)  # what became less is nowhere nearer than before
    return replace(grid, values_m=values)


def _window(
    grid: SdfGrid, T: Float[np.ndarray, "4 4"], extents: Float[np.ndarray, "3"], margin_m: float
) -> tuple[slice, slice, slice]:
    """Voxels around a box."""
    reach = np.abs(T[:3, :3]) @ (extents / 2) + margin_m
    low = np.floor((T[:3, 3] - reach - grid.origin_m) / grid.voxel_m).astype(int)
    high = np.ceil((T[:3, 3] + reach - grid.origin_m) / grid.voxel_m).astype(int) + 1
    ends = zip(
        np.maximum(low, 0).tolist(), np.clip(high, 0, grid.values_m.shape).tolist(), strict=True
    )
    x, y, z = (slice(a, max(a, b)) for a, b in ends)
    return x, y, z


_STILL_M = 1e-9
_SAMPLES = 4


StaticObstacle = tuple[Solid, int, Float[np.ndarray, "4 4"]]
"""The table or a panel of a container, which of the body's it is, and ``T_base_solid``."""


def static_obstacles(
    panels: Sequence[tuple[str, int, PanelBox]],  # a container, which of its boxes, and that box
    table_height_m: float,  # of its top, over the robot's base
) -> list[StaticObstacle]:
    """The table and the panels, each in its own frame."""
    T_base_table = np.eye(4)
    T_base_table[2, 3] = table_height_m
    found: list[StaticObstacle] = [(half_space_solid(TABLE), 0, T_base_table)]
    for name, piece, (T, extents) in panels:
        found.append((solid_of(name, coal.Box(*extents), box_corners(extents)), piece, T))
    return found


@lru_cache(maxsize=4)
def stationary_links(hulls: RobotHulls) -> tuple[frozenset[str], Foot | None]:
    """Links whose height no motion changes: the base, and a shoulder that turns about vertical.

    The robot stands on the table with them, so their distance to it says nothing of a plan. With
    them the cylinder about the base's z axis that holds them.
    """
    rng = np.random.default_rng(0)
    corners = []
    for _ in range(_SAMPLES):
        hulls.place(rng.uniform(-1.0, 1.0, len(hulls.robot.arm_ids)), 0.0)
        corners.append(
            [
                hull.points_m @ R.T + t
                for hull, R, t in zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True)
            ]
        )
    lowest = np.array([[points[:, 2].min() for points in posture] for posture in corners])
    stationary = np.flatnonzero(np.ptp(lowest, axis=0) < _STILL_M)
    if not len(stationary):
        return frozenset(), None
    held = np.concatenate([posture[index] for posture in corners for index in stationary])
    foot = Foot(
        radius_m=float(np.hypot(held[:, 0], held[:, 1]).max()), top_m=float(held[:, 2].max())
    )
    return frozenset(hulls.hulls[index].link for index in stationary), foot
