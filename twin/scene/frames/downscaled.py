"""Small depth images: enough to see whether poses and depth fit together."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera

TOLERANCE_M = 0.004
TOLERANCE_FRACTION = 0.025
"""Depths that differ by less than both together agree."""


@dataclass(frozen=True, kw_only=True)
class DownscaledDepth:
    """Every few pixels of one depth image, with the pose of its camera."""

    stamp_ns: int
    camera: Camera
    depth_m: Float32[np.ndarray, "height width"]
    """0 where nothing was measured."""
    T_base_depth: Float[np.ndarray, "4 4"]
    grey: Float32[np.ndarray, "height width"] | None = None
    """Brightness of the same pixels, where it was looked up."""


@dataclass(frozen=True, kw_only=True)
class Meeting:
    """What two depth images say about a relative pose."""

    overlap: float
    """Share of the first image's measurements that fall on measurements of the second."""
    agreement: float
    """Share of those whose depth is the same; 0 without any."""
    likeness: float = 0.0
    """Correlation of their brightness where depth agrees; 0 without greys."""


def downscaled_depth(frame: RgbdFrame, width_px: int) -> DownscaledDepth:
    """Take every n-th pixel so that about this many columns remain; nothing is averaged.

    Args:
        width_px: Columns that are wanted; an image with fewer stays as it is.
    """
    step = max(1, round(frame.depth_camera.width / width_px))
    depth = np.ascontiguousarray(frame.depth_m[::step, ::step], dtype=np.float32)
    return DownscaledDepth(
        stamp_ns=frame.stamp_ns,
        camera=thinned_camera(frame.depth_camera, step),
        depth_m=np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0)),
        T_base_depth=frame.T_base_depth,
    )


def thinned_camera(camera: Camera, step: int) -> Camera:
    """The camera whose pixel (i, j) looks where pixel (i step, j step) looked."""
    return Camera(
        width=-(-camera.width // step),
        height=-(-camera.height // step),
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=(camera.cx - 0.5) / step + 0.5,
        cy=(camera.cy - 0.5) / step + 0.5,
    )


def colors_in_depth(frame: RgbdFrame, step: int) -> UInt8[np.ndarray, "height width 3"]:
    """Colour of every n-th depth pixel, looked up in a colour camera that may stand elsewhere.

    Black where the colour camera does not see the point.
    """
    depth = np.nan_to_num(frame.depth_m[::step, ::step], posinf=0.0)
    p_depth = thinned_camera(frame.depth_camera, step).unproject(depth)
    p_color = se3.apply(se3.invert(frame.T_base_color) @ frame.T_base_depth, p_depth)
    row, column, inside = pixels_of(frame.color_camera, p_color)
    colors = np.zeros((*depth.shape, 3), dtype=np.uint8)
    colors[inside] = frame.image_u8[row[inside], column[inside]]
    return colors


def meet(
    first: DownscaledDepth, second: DownscaledDepth, T_second_first: Float[np.ndarray, "4 4"]
) -> Meeting:
    """Carry the first image's points into the second and compare depths, and greys if there."""
    measured = first.depth_m > 0
    p = first.camera.unproject(first.depth_m.astype(np.float64))[measured]
    p_second = se3.apply(T_second_first, p)
    row, column, inside = pixels_of(second.camera, p_second)
    z = p_second[inside, 2]
    found = second.depth_m[row[inside], column[inside]]
    met = found > 0
    num_met = int(met.sum())
    if num_met == 0:
        return Meeting(overlap=0.0, agreement=0.0)
    near = np.abs(z[met] - found[met]) <= TOLERANCE_M + TOLERANCE_FRACTION * z[met]
    likeness = 0.0
    if first.grey is not None and second.grey is not None and near.any():
        mine = first.grey[measured][inside][met][near]
        theirs = second.grey[row[inside], column[inside]][met][near]
        with np.errstate(invalid="ignore", divide="ignore"):  # images without any texture
            likeness = float(np.nan_to_num(np.corrcoef(mine, theirs)[0, 1]))
    return Meeting(overlap=num_met / len(p), agreement=float(near.mean()), likeness=likeness)


def pixels_of(
    camera: Camera, p_camera: Float[np.ndarray, "*batch 3"]
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "*batch"]]:
    """Row and column of the pixel each point falls on, and which points do."""
    front = p_camera[..., 2] > 1e-3
    safe = np.where(front[..., None], p_camera, 1.0)
    uv, _ = camera.project(safe)
    uv = np.clip(uv, -1.0, 1e6)  # far outside would not fit an integer
    column, row = np.floor(uv[..., 0]).astype(np.int64), np.floor(uv[..., 1]).astype(np.int64)
    inside = front & (column >= 0) & (column < camera.width)
    inside &= (row >= 0) & (row < camera.height)
    return row, column, inside
