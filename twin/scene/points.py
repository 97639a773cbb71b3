"""Coloured, oriented points of one RGB-D frame, and its depth as the colour camera sees it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera

NEAR_M = 0.05


@dataclass(frozen=True, kw_only=True)
class PointSet:
    """Surface points in the root frame."""

    p_m: Float32[np.ndarray, "num_points 3"]
    normals: Float32[np.ndarray, "num_points 3"]
    """Unit vectors towards the camera."""
    colors: Float32[np.ndarray, "num_points 3"]
    footprint_m: Float32[np.ndarray, " num_points"]
    """Size of a colour pixel at the point, z/f."""


def trusted_depth_mask(
    depth_m: Float[np.ndarray, "height width"], *, flying_fraction: float, max_depth_m: float
) -> Bool[np.ndarray, "height width"]:
    """Mark measurements that exist, are near enough, and do not fly between two surfaces.

    0 is "no measurement" and never passes. A pixel flies when its depth differs from that of a
    neighbour by more than ``flying_fraction``.
    """
    valid = (depth_m > NEAR_M) & (depth_m < max_depth_m)
    flying = np.zeros_like(valid)
    for axis in (0, 1):
        step = np.abs(np.diff(depth_m, axis=axis))
        near = np.minimum(
            np.take(depth_m, range(depth_m.shape[axis] - 1), axis=axis),
            np.take(depth_m, range(1, depth_m.shape[axis]), axis=axis),
        )
        jump = step > flying_fraction * near
        before = [slice(None)] * 2
        after = [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        flying[tuple(before)] |= jump
        flying[tuple(after)] |= jump
    return valid & ~flying


def frame_points(
    frame: RgbdFrame, *, flying_fraction: float, max_depth_m: float, stride: int = 1
) -> PointSet:
    """Back-project the depth image and look each point up in the colour image.

    Depth and colour cameras may differ; points outside the colour image, or hidden from the
    colour camera by a nearer surface, are left out.
    """
    trusted = trusted_depth_mask(
        frame.depth_m, flying_fraction=flying_fraction, max_depth_m=max_depth_m
    )
    p_depth = frame.depth_camera.unproject(frame.depth_m)
    normals, has_normal = _normals(p_depth, trusted)
    chosen = np.zeros_like(trusted)
    chosen[::stride, ::stride] = True
    chosen &= has_normal
    p_base = se3.apply(frame.T_base_depth, p_depth[chosen])
    p_color = se3.apply(se3.invert(frame.T_base_color), p_base)
    uv, z = frame.color_camera.project(np.where(p_color[:, 2:] > NEAR_M, p_color, 1.0))
    seen = _seen(uv, z, frame.color_camera, p_color[:, 2] > NEAR_M)
    return PointSet(
        p_m=p_base[seen].astype(np.float32),
        normals=(normals[chosen][seen] @ frame.T_base_depth[:3, :3].T).astype(np.float32),
        colors=_sample(frame.image_u8, uv[seen]),
        footprint_m=(z[seen] / frame.color_camera.fx).astype(np.float32),
    )


def _normals(
    p: Float[np.ndarray, "height width 3"], trusted: Bool[np.ndarray, "height width"]
) -> tuple[np.ndarray, np.ndarray]:
    """Cross product of central differences over 5 pixels; facing the camera."""
    reach = 2
    normals = np.zeros_like(p)
    ok = np.zeros_like(trusted)
    inner = (slice(reach, -reach), slice(reach, -reach))
    left, right = p[reach:-reach, : -2 * reach], p[reach:-reach, 2 * reach :]
    up, down = p[: -2 * reach, reach:-reach], p[2 * reach :, reach:-reach]
    across = np.cross(down - up, right - left)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    across = across / np.maximum(length, 1e-12)
    facing = np.sum(across * p[inner], axis=-1, keepdims=True) < 0
    normals[inner] = np.where(facing, across, -across)
    ok[inner] = (
        trusted[inner]
        & trusted[reach:-reach, : -2 * reach]
        & trusted[reach:-reach, 2 * reach :]
        & trusted[: -2 * reach, reach:-reach]
        & trusted[2 * reach :, reach:-reach]
        & (length[..., 0] > 1e-12)
    )
    return normals, ok


def _seen(uv: np.ndarray, z: np.ndarray, camera: Camera, in_front: np.ndarray) -> np.ndarray:
    """Points inside the image and not behind a nearer one of the same 4-pixel cell."""
    inside = in_front & (uv[:, 0] >= 1) & (uv[:, 0] < camera.width - 1)
    inside &= (uv[:, 1] >= 1) & (uv[:, 1] < camera.height - 1)
    cell = 4
    columns = camera.width // cell + 1
    index = (uv[inside, 1] // cell).astype(int) * columns + (uv[inside, 0] // cell).astype(int)
    nearest = np.full(columns * (camera.height // cell + 1), np.inf)
    np.minimum.at(nearest, index, z[inside])
    seen: np.ndarray = inside.copy()
    seen[inside] = z[inside] < nearest[index] * 1.05 + 0.02
    return seen


def _sample(image_u8: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear lookup; pixel centres at +0.5."""
    x, y = uv[:, 0] - 0.5, uv[:, 1] - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top = image_u8[y0, x0] * (1 - fx) + image_u8[y0, x0 + 1] * fx
    bottom = image_u8[y0 + 1, x0] * (1 - fx) + image_u8[y0 + 1, x0 + 1] * fx
    return ((top * (1 - fy) + bottom * fy) / 255.0).astype(np.float32)


def depth_in_color_camera(
    frame: RgbdFrame, camera: Camera, *, flying_fraction: float, max_depth_m: float
) -> Float32[np.ndarray, "height width"]:
    """Depth along the colour camera's axis at the size of ``camera``; 0 where unknown.

    ``camera`` is the frame's colour camera, possibly resized. Of several measurements in one
    pixel the nearest counts.
    """
    trusted = trusted_depth_mask(
        frame.depth_m, flying_fraction=flying_fraction, max_depth_m=max_depth_m
    )
    p_depth = frame.depth_camera.unproject(frame.depth_m)[trusted]
    T_color_depth = se3.invert(frame.T_base_color) @ frame.T_base_depth
    uv, z = camera.project(se3.apply(T_color_depth, p_depth))
    inside = (z > NEAR_M) & (uv[:, 0] >= 0) & (uv[:, 0] < camera.width)
    inside &= (uv[:, 1] >= 0) & (uv[:, 1] < camera.height)
    column, row = uv[inside, 0].astype(int), uv[inside, 1].astype(int)
    nearest = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    np.minimum.at(nearest, (row, column), z[inside].astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, np.float32(0.0))
