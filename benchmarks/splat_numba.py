"""A scalar rasteriser with gradients in numba, one pixel at a time: the reference for speed.

Same equations and cuts as the native one. Projection is plain NumPy and stays outside what is
timed, and its gradient is left out, so that comparisons favour this side.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud

TILE = 16
ALPHA_CUT, MAX_ALPHA, STOP = np.float32(1 / 255), np.float32(0.999), np.float32(1e-4)
MIP_VARIANCE_PX2, NEAR_M = 0.1, 0.02
ONE, HALF = np.float32(1.0), np.float32(0.5)


@dataclass(frozen=True, kw_only=True)
class Ellipses:
    """Visible Gaussians in the image, nearest first."""

    index: np.ndarray
    """Rows of the cloud."""
    shape: np.ndarray
    """u, v, the three entries of the inverse covariance, opacity."""
    channels: np.ndarray
    """Red, green, blue, depth."""
    tiles: np.ndarray
    """First and last tile in x, then in y; ends excluded."""


def project(cloud: GaussianCloud, camera: Camera) -> Ellipses:
    """Project a cloud given in the camera's own frame."""
    p = cloud.means_m.astype(np.float64)
    x, y, z = p.T
    J = np.zeros((len(p), 2, 3))
    J[:, 0, 0], J[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    J[:, 1, 1], J[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    A = J @ _rotations(cloud.quats_wxyz.astype(np.float64))
    A = A * np.exp(cloud.scales_log.astype(np.float64))[:, None, :]
    cov = A @ A.transpose(0, 2, 1)
    mip = cov + MIP_VARIANCE_PX2 * np.eye(2)
    ratio = np.maximum(np.linalg.det(cov) / np.linalg.det(mip), 2.5e-5)
    opacity = cloud.opacities() * np.sqrt(ratio)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    reach = np.sqrt(np.maximum(2 * np.log(np.maximum(opacity, 1e-9) / ALPHA_CUT), 0))
    half_x, half_y = reach * np.sqrt(mip[:, 0, 0]), reach * np.sqrt(mip[:, 1, 1])
    seen = (opacity > ALPHA_CUT) & (z > NEAR_M)
    seen &= (u + half_x > 0) & (u - half_x < camera.width)
    seen &= (v + half_y > 0) & (v - half_y < camera.height)
    order = np.flatnonzero(seen)[np.argsort(z[seen], kind="stable")]
    conic = np.linalg.inv(mip)
    shape = np.stack([u, v, conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1], opacity], axis=1)
    limits = np.array([camera.width, camera.height]) // -TILE * -1
    tiles = [
        np.clip((u - half_x) // TILE, 0, limits[0]),
        np.clip((u + half_x) // TILE + 1, 0, limits[0]),
    ]
    tiles += [
        np.clip((v - half_y) // TILE, 0, limits[1]),
        np.clip((v + half_y) // TILE + 1, 0, limits[1]),
    ]
    return Ellipses(
        index=order,
        shape=shape[order].astype(np.float32),
        channels=np.concatenate([cloud.colors, p[:, 2:]], axis=1)[order].astype(np.float32),
        tiles=np.stack(tiles, axis=1)[order].astype(np.int32),
    )


def _rotations(quats: np.ndarray) -> np.ndarray:
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


@njit
def fill_tiles(tiles: np.ndarray, tiles_x: int, tiles_y: int) -> tuple[np.ndarray, np.ndarray]:
    begin = np.zeros(tiles_x * tiles_y + 1, dtype=np.int64)
    for i in range(len(tiles)):
        for ty in range(tiles[i, 2], tiles[i, 3]):
            for tx in range(tiles[i, 0], tiles[i, 1]):
                begin[ty * tiles_x + tx + 1] += 1
    for tile in range(tiles_x * tiles_y):
        begin[tile + 1] += begin[tile]
    ids = np.empty(begin[-1], dtype=np.int32)
    end = begin.copy()
    for i in range(len(tiles)):
        for ty in range(tiles[i, 2], tiles[i, 3]):
            for tx in range(tiles[i, 0], tiles[i, 1]):
                ids[end[ty * tiles_x + tx]] = i
                end[ty * tiles_x + tx] += 1
    return begin, ids


@njit(fastmath=True)
def draw(
    shape: np.ndarray,
    channels: np.ndarray,
    begin: np.ndarray,
    ids: np.ndarray,
    tiles_x: int,
    width: int,
    height: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Planes as the native ones, and where each pixel stopped in its tile's list."""
    planes = np.zeros((5, height, width), dtype=np.float32)
    last = np.zeros((height, width), dtype=np.int64)
    for y in range(height):
        for x in range(width):
            tile = (y // TILE) * tiles_x + x // TILE
            light = ONE
            red = green = blue = depth = total = np.float32(0.0)
            for at in range(begin[tile], begin[tile + 1]):
                i = ids[at]
                dx, dy = np.float32(x) + HALF - shape[i, 0], np.float32(y) + HALF - shape[i, 1]
                square = shape[i, 2] * dx * dx + shape[i, 4] * dy * dy
                power = -HALF * square - shape[i, 3] * dx * dy
                alpha = min(MAX_ALPHA, shape[i, 5] * np.exp(power))
                if alpha < ALPHA_CUT:
                    continue
                weight = alpha * light
                red += weight * channels[i, 0]
                green += weight * channels[i, 1]
                blue += weight * channels[i, 2]
                depth += weight * channels[i, 3]
                total += weight
                light *= ONE - alpha
                last[y, x] = at + 1
                if light < STOP:
                    break
            planes[0, y, x], planes[1, y, x], planes[2, y, x] = red, green, blue
            planes[3, y, x], planes[4, y, x] = depth, total
    return planes, last


@njit(fastmath=True)
def pull(
    shape: np.ndarray,
    channels: np.ndarray,
    begin: np.ndarray,
    ids: np.ndarray,
    tiles_x: int,
    planes: np.ndarray,
    last: np.ndarray,
    upstream: np.ndarray,
) -> np.ndarray:
    """Gradients on ``shape`` (six columns) and ``channels`` (four)."""
    height, width = last.shape
    out = np.zeros((len(shape), 10), dtype=np.float32)
    for y in range(height):
        for x in range(width):
            tile = (y // TILE) * tiles_x + x // TILE
            g0, g1, g2 = upstream[0, y, x], upstream[1, y, x], upstream[2, y, x]
            g3, g4 = upstream[3, y, x], upstream[4, y, x]
            behind = g0 * planes[0, y, x] + g1 * planes[1, y, x] + g2 * planes[2, y, x]
            behind += g3 * planes[3, y, x] + g4 * planes[4, y, x]
            light = ONE
            for at in range(begin[tile], last[y, x]):
                i = ids[at]
                dx, dy = np.float32(x) + HALF - shape[i, 0], np.float32(y) + HALF - shape[i, 1]
                square = shape[i, 2] * dx * dx + shape[i, 4] * dy * dy
                strength = np.exp(-HALF * square - shape[i, 3] * dx * dy)
                alpha = min(MAX_ALPHA, shape[i, 5] * strength)
                if alpha < ALPHA_CUT:
                    continue
                weight = alpha * light
                value = g0 * channels[i, 0] + g1 * channels[i, 1] + g2 * channels[i, 2]
                value += g3 * channels[i, 3] + g4
                behind -= weight * value
                d_alpha = light * value - behind / (ONE - alpha)
                light *= ONE - alpha
                out[i, 6] += weight * g0
                out[i, 7] += weight * g1
                out[i, 8] += weight * g2
                out[i, 9] += weight * g3
                if alpha < MAX_ALPHA:
                    e = d_alpha * alpha
                    out[i, 0] += e * (shape[i, 2] * dx + shape[i, 3] * dy)
                    out[i, 1] += e * (shape[i, 3] * dx + shape[i, 4] * dy)
                    out[i, 2] -= HALF * e * dx * dx
                    out[i, 3] -= e * dx * dy
                    out[i, 4] -= HALF * e * dy * dy
                    out[i, 5] += d_alpha * strength
    return out


def draw_and_pull(
    ellipses: Ellipses, camera: Camera, upstream: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What is timed: tiles, forward, backward. Returns planes and gradients by ellipse."""
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    begin, ids = fill_tiles(ellipses.tiles, tiles_x, tiles_y)
    content = (ellipses.shape, ellipses.channels, begin, ids, tiles_x)
    planes, last = draw(*content, camera.width, camera.height)
    return planes, pull(*content, planes, last, upstream)
