"""One RGB-D frame as oriented, coloured points and as a training view at half and full size."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.scene.gaussians import as_float32

NEAR_M = 0.05
NORMAL_REACH_PX = 2
"""Normals come from the pixels this far to each side."""
SEAMED = 0.3
"""With a smaller share of measured pixels among measured neighbours, gaps are the rule."""
SAME_SURFACE = 1.03
"""Measurements in one pixel up to this many times the nearest are of its surface. They are
averaged: the nearest of several noisy ones is too near."""
OCCLUSION_CELL_PX = 4
"""Size of the cells in which the nearest point hides those behind it."""


@dataclass(frozen=True, kw_only=True)
class PointSet:
    """Surface points in the root frame."""

    p_m: Float32[np.ndarray, "num_points 3"]
    normals: Float32[np.ndarray, "num_points 3"]
    """Unit vectors towards the camera."""
    colors: Float32[np.ndarray, "num_points 3"]
    footprint_m: Float32[np.ndarray, " num_points"]
    """Size of a colour pixel at the point, z/f."""

    def take(self, chosen: Bool[np.ndarray, " num_points"]) -> "PointSet":
        """Return some of the points."""
        return PointSet(**{name: rows[chosen] for name, rows in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class DepthLimits:
    """Which depth measurements are trusted."""

    max_depth_m: float
    """Depth beyond is left out."""
    flying_fraction: float = 0.03
    """A pixel flies when its depth differs from a neighbour's by more than this share."""


def trusted_depth_mask(
    depth_m: Float[np.ndarray, "height width"], limits: DepthLimits
) -> Bool[np.ndarray, "height width"]:
    """Mark measurements that exist, are near enough, and do not fly between two surfaces.

    0 is "no measurement" and never passes, and neither do its neighbours.

    Args:
        depth_m: Along the optical axis; 0 is "not measured".
    """
    trusted = (depth_m > NEAR_M) & (depth_m < limits.max_depth_m)
    for before, after in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        near, far = depth_m[before], depth_m[after]
        jump = np.abs(near - far) > limits.flying_fraction * np.minimum(near, far)
        trusted[before] &= ~jump
        trusted[after] &= ~jump
    return trusted


def without_seams(
    depth_m: Float32[np.ndarray, "height width"], flying_fraction: float
) -> Float32[np.ndarray, "height width"]:
    """Close gaps one pixel wide between measurements that agree, where gaps are the rule.

    Depth warped into a larger colour image has empty rows and columns; without this no pixel of
    it would have neighbours to take a normal from. Closed gaps serve as neighbours only, they
    never become points. Depth with ordinary holes is returned as it is.

    Args:
        depth_m: Along the optical axis; 0 is "not measured".
        flying_fraction: Measurements that differ by less than this share of the nearer one agree.
    """
    known = depth_m > 0
    whole = known[1:-1, 1:-1] & known[:-2, 1:-1] & known[2:, 1:-1]
    whole &= known[1:-1, :-2] & known[1:-1, 2:]
    if whole.sum() >= SEAMED * known.sum():
        return depth_m
    closed = depth_m.copy()
    for _ in range(2):  # where an empty row crosses an empty column, the second pass closes
        for filled, last in ((closed, closed.copy()), (closed.T, closed.T.copy())):
            before, after = last[:-2], last[2:]
            near = np.abs(before - after) <= flying_fraction * np.minimum(before, after)
            gap = (last[1:-1] == 0) & (before > 0) & (after > 0) & near
            filled[1:-1][gap] = (0.5 * (before + after))[gap]
    return closed


class FrameSurface:
    """The trusted surface points of one frame; what initialisation and fit both start from."""

    def __init__(self, frame: RgbdFrame, limits: DepthLimits) -> None:
        """Find the trusted pixels and carry them to the colour camera."""
        self.frame = frame
        depth = np.where(np.isfinite(frame.depth_m), frame.depth_m, 0.0).astype(np.float32)
        measured = depth > 0
        depth = without_seams(depth, limits.flying_fraction)
        self._backed = trusted_depth_mask(depth, limits)
        self.trusted = self._backed & measured
        camera = frame.depth_camera
        column = ((np.arange(camera.width) + 0.5 - camera.cx) / camera.fx).astype(np.float32)
        row = ((np.arange(camera.height) + 0.5 - camera.cy) / camera.fy).astype(np.float32)
        self._p_depth = np.stack([depth * column, depth * row[:, None], depth])

    def points(self, stride: int = 1) -> PointSet:
        """Every ``stride``-th pixel of every ``stride``-th row as an oriented, coloured point.

        Depth and colour cameras may differ; points outside the colour image, or hidden from the
        colour camera by a nearer surface, are left out.
        """
        row, column, normals = oriented(self._p_depth, self.trusted, self._backed, stride)
        p_depth = self._p_depth[:, row, column]
        p_color = _carry(self._T_color_depth(), p_depth)
        u, v = _pixels(self.frame.color_camera, p_color)
        seen = _seen(u, v, p_color[2], self.frame.color_camera)
        T = self.frame.T_base_depth
        return PointSet(
            p_m=np.ascontiguousarray(_carry(T, p_depth[:, seen]).T),
            normals=np.ascontiguousarray(_turn(T, normals[:, seen]).T),
            colors=_sample(self.frame.image_u8, u[seen], v[seen]),
            footprint_m=p_color[2, seen] / np.float32(self.frame.color_camera.fx),
        )

    def depth_in_color_camera(self) -> Float32[np.ndarray, "height width"]:
        """Depth along the colour camera's axis at its size; 0 where unknown.

        Of several measurements in one pixel those of the nearest surface are averaged.
        """
        camera = self.frame.color_camera
        p = _carry(self._T_color_depth(), self._p_depth[:, self.trusted])
        u, v = _pixels(camera, p)
        inside = (p[2] > NEAR_M) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        index = v[inside].astype(np.int32) * camera.width + u[inside].astype(np.int32)
        z = p[2, inside]
        nearest = np.full(camera.width * camera.height, np.inf, dtype=np.float32)
        np.minimum.at(nearest, index, z)
        same = z <= SAME_SURFACE * nearest[index]
        count = np.bincount(index[same], minlength=len(nearest))
        total = np.bincount(index[same], weights=z[same], minlength=len(nearest))
        depth = total / np.maximum(count, 1)
        return as_float32(depth.reshape(camera.height, camera.width))

    def _T_color_depth(self) -> Float[np.ndarray, "4 4"]:
        return np.asarray(se3.invert(self.frame.T_base_color) @ self.frame.T_base_depth)


def oriented(
    p: Float[np.ndarray, "3 height width"],
    trusted: Bool[np.ndarray, "height width"],
    backed: Bool[np.ndarray, "height width"],
    stride: int = 1,
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "3 num_points"]]:
    """Trusted pixels on a grid whose neighbours at the normal's reach are backed, and normals.

    Cross products of central differences, of unit length, facing the camera.
    """
    reach = NORMAL_REACH_PX
    row, column = np.nonzero(trusted[reach:-reach:stride, reach:-reach:stride])
    row, column = row * stride + reach, column * stride + reach
    ok = np.ones(len(row), dtype=bool)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        ok &= backed[row + down * reach, column + right * reach]
    row, column = row[ok], column[ok]
    ax, ay, az = p[:, row, column + reach] - p[:, row, column - reach]
    bx, by, bz = p[:, row + reach, column] - p[:, row - reach, column]
    n = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    n /= np.maximum(np.sqrt(np.square(n).sum(axis=0)), np.float32(1e-12))
    away = (n * p[:, row, column]).sum(axis=0) > 0
    return row, column, np.where(away, -n, n)


def _turn(T: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rotate vectors given as three rows (fast in float32, unlike a 3x3 matrix product)."""
    R = T[:3, :3].astype(np.float32)
    return np.stack([R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2] for i in range(3)])


def _carry(T: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.asarray(_turn(T, p) + T[:3, 3:].astype(np.float32))


def _pixels(camera: Camera, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inverse = 1.0 / np.maximum(p[2], np.float32(NEAR_M))
    u = np.float32(camera.fx) * p[0] * inverse + np.float32(camera.cx)
    v = np.float32(camera.fy) * p[1] * inverse + np.float32(camera.cy)
    return u, v


def _seen(u: np.ndarray, v: np.ndarray, z: np.ndarray, camera: Camera) -> np.ndarray:
    """Points inside the image and not behind a nearer one of the same 4-pixel cell."""
    seen: np.ndarray = (z > NEAR_M) & (u >= 1) & (u < camera.width - 1)
    seen &= (v >= 1) & (v < camera.height - 1)
    columns = camera.width // OCCLUSION_CELL_PX + 1
    index = (v[seen] / OCCLUSION_CELL_PX).astype(np.int32) * columns
    index += (u[seen] / OCCLUSION_CELL_PX).astype(np.int32)
    nearest = np.full(columns * (camera.height // OCCLUSION_CELL_PX + 1), np.inf, np.float32)
    np.minimum.at(nearest, index, z[seen])
    seen[seen] = z[seen] < nearest[index] * 1.05 + 0.02
    return seen


def _sample(image_u8: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear lookup; pixel centres at +0.5."""
    x, y = u - np.float32(0.5), v - np.float32(0.5)
    x0, y0 = x.astype(np.int32), y.astype(np.int32)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top = image_u8[y0, x0] * (1 - fx) + image_u8[y0, x0 + 1] * fx
    bottom = image_u8[y0 + 1, x0] * (1 - fx) + image_u8[y0 + 1, x0 + 1] * fx
    return as_float32((top * (1 - fy) + bottom * fy) * (1 / 255))


@dataclass(frozen=True, kw_only=True)
class Target:
    """What a camera of one size should see; 8-bit in memory, float where it is used."""

    camera: Camera
    planes_u8: UInt8[np.ndarray, "3 height width"]
    depth_m: Float32[np.ndarray, "height width"]
    """Along the colour camera's axis; 0 where it was not measured."""
    static_mask: Bool[np.ndarray, "height width"]
    """False where something moving stood in the way; the fit passes these pixels over."""

    def image(self) -> Float32[np.ndarray, "3 height width"]:
        """Colour planes, 0..1."""
        return self.planes_u8.astype(np.float32) * np.float32(1 / 255)

    def without(self, hit: Bool[np.ndarray, "height width"]) -> "Target":
        """The same with some pixels passed over, beside those that already are."""
        return replace(
            self,
            static_mask=self.static_mask & ~hit,
            depth_m=np.where(hit, np.float32(0.0), self.depth_m),
        )


@dataclass(frozen=True, kw_only=True)
class TrainingView:
    """One training image with its pose."""

    camera_id: str
    stamp_ns: int
    T_base_color: Float[np.ndarray, "4 4"]
    half: Target
    full: Target

    def without(self, half_hit: Bool[np.ndarray, "half_height half_width"]) -> "TrainingView":
        """The same with some pixels of the half-size image passed over, at both sizes."""
        if not half_hit.any():
            return self
        height, width = self.full.depth_m.shape
        hit = np.repeat(np.repeat(half_hit, 2, axis=0), 2, axis=1)[:height, :width]
        return replace(self, half=self.half.without(half_hit), full=self.full.without(hit))


def training_view(surface: FrameSurface) -> TrainingView:
    """Prepare one frame; the half-size image is the mean of 2 x 2 pixels."""
    frame = surface.frame
    depth_m = surface.depth_in_color_camera()
    width, height = (side + side % 2 for side in frame.image_u8.shape[1::-1])
    half = replace(frame.color_camera, width=width, height=height).scaled(0.5)  # whole blocks
    total = _blocks(frame.image_u8, half).sum(axis=(1, 3), dtype=np.uint16)
    # Of each block the mean of its nearest surface; blocks without a measurement stay 0.
    known = _blocks(np.where(depth_m > 0, depth_m, np.float32(np.inf)), half)
    nearest = known.min(axis=(1, 3), keepdims=True)
    same = (known <= np.float32(SAME_SURFACE) * nearest) & np.isfinite(known)
    sums = np.where(same, known, np.float32(0.0)).sum(axis=(1, 3))
    half_m = as_float32(sums / np.maximum(same.sum(axis=(1, 3)), 1))
    return TrainingView(
        camera_id=frame.camera_id,
        stamp_ns=frame.stamp_ns,
        T_base_color=frame.T_base_color,
        half=_target(half, (total + 2) // 4, half_m),
        full=_target(frame.color_camera, frame.image_u8, depth_m),
    )


def _target(camera: Camera, image_u8: np.ndarray, depth_m: np.ndarray) -> Target:
    planes = np.ascontiguousarray(np.moveaxis(image_u8, -1, 0), dtype=np.uint8)
    everywhere = np.ones(depth_m.shape, dtype=bool)
    return Target(camera=camera, planes_u8=planes, depth_m=depth_m, static_mask=everywhere)


def _blocks(rows: np.ndarray, camera: Camera) -> np.ndarray:
    """Group 2 x 2 pixels: (height, 2, width, 2, ...); an odd edge is repeated."""
    height, width = camera.height * 2, camera.width * 2
    missing = ((0, height - len(rows)), (0, width - rows.shape[1]))
    padded = np.pad(rows, missing + ((0, 0),) * (rows.ndim - 2), mode="edge")
    shape = (camera.height, 2, camera.width, 2, *rows.shape[2:])
    return np.asarray(padded.reshape(shape))
