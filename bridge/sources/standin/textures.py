"""Surface colours of the laboratory, made from a seed: wood, patches, floor, walls.

A texture is a picture laid over a rectangle of a plane; features are several millimetres wide so
that a camera half a metre away sees them without aliasing.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, zoom

TABLE_RESOLUTION_M = 0.001
ROOM_RESOLUTION_M = 0.01


@dataclass(frozen=True, kw_only=True)
class Texture:
    """Colours (0..1, sRGB) over a rectangle that starts at ``origin_m``."""

    image: Float[np.ndarray, "rows columns 3"]
    origin_m: tuple[float, float]
    resolution_m: float

    def sample(
        self, points_m: Float[np.ndarray, "num_points 2"]
    ) -> Float[np.ndarray, "num_points 3"]:
        """Take the nearest cell; cells are finer than a camera's pixel. Outside: the edge."""
        rows, columns = self.image.shape[:2]
        origin = np.array(self.origin_m, dtype=np.float32)
        grid = ((points_m.astype(np.float32) - origin) / np.float32(self.resolution_m)).astype(
            np.int32
        )
        np.clip(grid, 0, np.array([columns - 1, rows - 1], dtype=np.int32), out=grid)
        index = grid[:, 1] * np.int32(columns) + grid[:, 0]
        return np.asarray(self.image.reshape(-1, 3).take(index, axis=0))


def table_texture(size_m: tuple[float, float], centre_m: tuple[float, float], seed: int) -> Texture:
    """Wooden boards along y with grain, and patches of coloured tape and checkers."""
    rng = np.random.default_rng([7, seed])
    columns, rows = (round(extent / TABLE_RESOLUTION_M) for extent in size_m)
    wood = np.array([0.78, 0.63, 0.46])
    image = np.empty((rows, columns, 3))
    board = max(round(0.13 / TABLE_RESOLUTION_M), 1)
    for start in range(0, columns, board):
        width = min(board, columns - start)
        tint = wood * rng.uniform(0.86, 1.08) + rng.normal(0, 0.012, 3)
        grain = gaussian_filter(rng.normal(0, 1, (rows, width)), (44.0, 3.2))
        image[:, start : start + width] = tint + 1.8 * grain[..., None] * np.array([1.0, 0.9, 0.7])
        image[:, start : start + 2] *= 0.55
    origin = (centre_m[0] - size_m[0] / 2, centre_m[1] - size_m[1] / 2)
    _add_patches(image, origin, rng)
    image = gaussian_filter(np.clip(image, 0, 1), (0.9, 0.9, 0)).astype(np.float32)
    return Texture(image=image, origin_m=origin, resolution_m=TABLE_RESOLUTION_M)


PATCH_COLORS = (
    (0.93, 0.78, 0.16),
    (0.16, 0.50, 0.33),
    (0.92, 0.91, 0.88),
    (0.15, 0.17, 0.22),
    (0.45, 0.30, 0.58),
    (0.90, 0.52, 0.20),
)


def _add_patches(
    image: Float[np.ndarray, "rows columns 3"],
    origin_m: tuple[float, float],
    rng: np.random.Generator,
) -> None:
    """Tape rectangles, and 3 x 3 checkers like printed markers, on a loose grid."""
    rows, columns = image.shape[:2]
    cell = 0.15
    for x in np.arange(origin_m[0] + 0.05, origin_m[0] + columns * TABLE_RESOLUTION_M, cell):
        for y in np.arange(origin_m[1] + 0.05, origin_m[1] + rows * TABLE_RESOLUTION_M, cell):
            p = np.array([x, y]) + rng.uniform(0.0, 0.07, 2)
            size = rng.uniform(0.025, 0.06, 2)
            checker = rng.random() < 0.45
            if checker:
                size[:] = 0.042
            first, second = rng.choice(len(PATCH_COLORS), 2, replace=False)
            i, j = ((p - origin_m) / TABLE_RESOLUTION_M).astype(int)
            w, h = np.ceil(size / TABLE_RESOLUTION_M).astype(int)
            block = image[j : j + h, i : i + w]
            block[:] = PATCH_COLORS[first]
            if checker:
                squares = rng.random((3, 3)) < 0.5
                scale = -(-max(h, w) // 3)
                mask = np.kron(squares, np.ones((scale, scale), dtype=bool))
                block[mask[: block.shape[0], : block.shape[1]]] = PATCH_COLORS[second]


def room_texture(
    size_m: tuple[float, float], base: tuple[float, float, float], seed: int
) -> Texture:
    """Floor or wall: large soft blotches and tile lines, low contrast."""
    rng = np.random.default_rng([8, seed])
    columns, rows = (round(extent / ROOM_RESOLUTION_M) for extent in size_m)
    coarse = rng.normal(0, 1, (rows // 12 + 2, columns // 12 + 2))
    blotch = zoom(coarse, 12, order=1)[:rows, :columns]
    image = np.array(base) * (1 + 0.09 * blotch[..., None])
    tile = round(0.5 / ROOM_RESOLUTION_M)
    image[::tile] *= 0.7
    image[:, ::tile] *= 0.7
    image = gaussian_filter(np.clip(image, 0, 1), (0.8, 0.8, 0)).astype(np.float32)
    return Texture(image=image, origin_m=(0.0, 0.0), resolution_m=ROOM_RESOLUTION_M)
