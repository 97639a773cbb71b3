"""Signed distances to everything that stands still: the scene without its objects.

Three kinds of place: free (at least two views looked through it), surface (measured, or below the
table), and unseen: no view looked through it and none measured a surface there, because it is
behind something, or in no image at all. Two grids answer two questions. The conservative one takes
the unseen for solid; the observed one takes it for free. Beyond the grid nothing is known.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from twin.npz import UnreadableArraysError, read_npz, write_npz
from twin.scene.frames.rgbd import TrainingView
from twin.scene.frames.selection import spread
from twin.scene.shape.carve import MaskedView, ShapeError, VoxelBox, gather
from twin.scene.shape.sdf import MAX_VOXELS, SdfGrid, distances_of_solid

OBSERVED = "observed_m"
"""Name of that grid's distances in the file."""
MIN_POINTS = 100
POINTS_PER_VIEW = 2000
OBJECT_MARGIN_VOXELS = 1.5
"""Voxels this near to an object were seen as the object; the scene is free of them."""
VOXELS_AT_ONCE = 100_000
"""Looked up in the objects' distances together: some 300 bytes each."""

Distance = Callable[[Float[np.ndarray, "num_points 3"]], Float[np.ndarray, " num_points"]]
VOXEL_M, MAX_GRID = 0.008, 2_000_000
"""Wanted voxel, and most voxels: larger ones where the scene would need more."""
HEIGHT_M, BELOW_M, MAX_SIDE_M = 0.7, 0.04, 2.0
"""How far above and below the table the grid reaches; its longest side."""
TRUNCATION_VOXELS = 3.0
"""Depth within this many voxels of a surface says how far the surface is."""
MAX_VIEWS = 40
"""More views than this are thinned out evenly."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StaticSdf:
    """The static scene as distances."""

    conservative: SdfGrid
    """What nobody saw counts as solid."""
    observed: SdfGrid
    """What nobody saw counts as free."""

    def save(self, path: Path) -> None:
        """Write an npz file; ``SdfGrid.load`` finds the conservative grid in it."""
        write_npz(path, self.conservative.arrays() | {OBSERVED: self.observed.values_m})

    @staticmethod
    def load(path: Path) -> "StaticSdf":
        """Read what ``save`` wrote."""
        grid = SdfGrid.load(path)
        values = read_npz(path, (OBSERVED,), MAX_VOXELS * 4 + 4096)[OBSERVED]
        if values.shape != grid.values_m.shape:
            raise UnreadableArraysError(path=path, found="grids of different sizes")
        if not np.isfinite(values).all():
            raise UnreadableArraysError(path=path, found="a distance is not finite")
        observed = replace(grid, values_m=values, closed=False)
        return StaticSdf(conservative=grid, observed=observed)


def static_sdf(
    views: Sequence[TrainingView],
    table_z_m: float | None,
    objects: Sequence[Distance] = (),
) -> StaticSdf:
    """Fuse the training views into signed distances to what stands still.

    Args:
        views: What the scene was fitted to; pixels that show something moving are left out.
        table_z_m: Height of the table: all below is solid. None when there is none.
        objects: Distances to the things that may be moved: the scene is made free of them.
    """
    masked = [everything_in(views[k]) for k in spread(np.arange(len(views)), MAX_VIEWS)]
    box = _box(masked, table_z_m)
    evidence = gather(box, masked, TRUNCATION_VOXELS * box.voxel_m, min_free_views=2)
    free = evidence.empty.ravel()
    taken = np.flatnonzero(~free if objects else [])
    for first in range(0, len(taken), VOXELS_AT_ONCE):
        some = taken[first : first + VOXELS_AT_ONCE]
        places = box.centres_m(some)
        for distance in objects:
            free[some[distance(places) < OBJECT_MARGIN_VOXELS * box.voxel_m]] = True
    free = free.reshape(box.counts)
    surface = evidence.weight > 0
    if table_z_m is not None:
        below = box.axis_m(2) < table_z_m
        free[:, :, below], surface[:, :, below] = False, True
    return StaticSdf(conservative=_grid(box, ~free), observed=_grid(box, surface & ~free))


def everything_in(view: TrainingView) -> MaskedView:
    """All of a view that shows nothing moving."""
    target = view.full
    depth = np.where(target.static_mask, target.depth_m, np.float32(0.0))
    return MaskedView(
        camera=target.camera,
        T_base_camera=view.T_base_color,
        depth_m=depth,
        mask=np.ones(depth.shape, dtype=bool),
    )


def _box(views: Sequence[MaskedView], table_z_m: float | None) -> VoxelBox:
    """The box of what was seen, without the outermost hundredth, in voxels that fit the budget."""
    points = [view.points_m() for view in views]
    rows = [p[:: max(1, len(p) // POINTS_PER_VIEW)] for p in points if len(p)]
    seen = np.concatenate(rows) if rows else np.zeros((0, 3))
    if table_z_m is not None:
        height = seen[:, 2] - table_z_m
        seen = seen[(height > -BELOW_M) & (height < HEIGHT_M)]
    if len(seen) < MIN_POINTS:
        message = (
            f"{len(views)} views measured {len(seen)} points of the static scene, at least "
            f"{MIN_POINTS} are needed: no distances to it."
        )
        raise ShapeError(message)
    low, high = np.percentile(seen, [1, 99], axis=0)
    if table_z_m is not None:
        low[2], high[2] = table_z_m - BELOW_M, table_z_m + HEIGHT_M
    middle, half = (low + high) / 2, np.minimum((high - low) / 2, MAX_SIDE_M / 2)
    half = np.maximum(half, 2 * VOXEL_M)
    voxel = max(VOXEL_M, float(np.cbrt(np.prod(2 * half) / MAX_GRID)))
    counts = np.maximum(np.floor(2 * half / voxel), 2).astype(int)
    origin = middle - half + voxel / 2
    if table_z_m is not None:
        # The table top is a face between two layers, not the middle of one.
        layers = np.floor(BELOW_M / voxel)
        origin[2] = table_z_m - (layers - 0.5) * voxel
    num_x, num_y, num_z = counts.tolist()
    return VoxelBox(origin_m=origin, voxel_m=voxel, counts=(num_x, num_y, num_z))


def _grid(box: VoxelBox, solid: Bool[np.ndarray, "num_x num_y num_z"]) -> SdfGrid:
    if solid.all() or not solid.any():
        # Nothing to be far from: as far as the grid is large, on the side that is there.
        far = float(np.linalg.norm(box.counts)) * box.voxel_m
        values = np.full(box.counts, -far if solid.all() else far, dtype=np.float32)
    else:
        values = distances_of_solid(solid, box.voxel_m)
    return SdfGrid(values_m=values, origin_m=box.origin_m, voxel_m=box.voxel_m, closed=False)
