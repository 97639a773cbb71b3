"""The default segmenter on what is there: one RGB-D frame, or the Gaussians of a scene."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt16
from scipy import ndimage
from scipy.spatial import cKDTree

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from twin.scene.frames.points import DepthLimits, FrameSurface
from twin.scene.gaussians.cloud import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.semantics.cluster import SurfacePoints
from twin.scene.semantics.lift import Viewpoint, render_labels
from twin.scene.semantics.result import Mask, MaskSet
from twin.scene.semantics.segment import SOURCE, SegmentConfig, segment_points

MIN_OPACITY = 0.3
MAX_SPLAT_M = 0.04
"""Larger Gaussians are walls or fog."""
MIN_MASK_PX = 20
SILHOUETTE_M = 0.012
"""A measured point this near to a trusted one belongs to the same surface."""
VIEW_LIMITS = DepthLimits(max_depth_m=3.0, flying_fraction=0.03)


def solid_splats(cloud: GaussianCloud) -> np.ndarray:
    """Which Gaussians are surface: opaque and small."""
    small = np.exp(cloud.scales_log.max(axis=1)) < MAX_SPLAT_M if len(cloud) else np.zeros(0, bool)
    return np.asarray((cloud.opacities() > MIN_OPACITY) & small)


def points_of(cloud: GaussianCloud) -> SurfacePoints:
    """Gaussians as surface points: the normal is the thinnest axis.

    The initialisation turns the third axis towards the camera; where another axis became the
    thinnest, upwards is the better guess.
    """
    if len(cloud) == 0:
        none = np.zeros((0, 3))
        return SurfacePoints(p_m=none, normals=none, colors=none)
    R = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))
    thinnest = cloud.scales_log.argmin(axis=1)
    normals = np.take_along_axis(R, thinnest[:, None, None], axis=2)[:, :, 0]
    unsure = (thinnest != 2) & (normals[:, 2] < 0)
    normals[unsure] *= -1
    return SurfacePoints(
        p_m=cloud.means_m.astype(np.float64),
        normals=normals,
        colors=np.clip(cloud.colors, 0.0, 1.0).astype(np.float64),
    )


def segment_frame(
    frame: RgbdFrame,
    config: SegmentConfig | None = None,
    robot_m: Float[np.ndarray, "num_robot 3"] | None = None,
) -> MaskSet:
    """Segment one RGB-D frame without knowing anything else.

    Raises:
        NoSupportError: When no level plane is in view.
    """
    surface = FrameSurface(frame, VIEW_LIMITS)
    cloud = surface.points()
    points = SurfacePoints(
        p_m=cloud.p_m.astype(np.float64),
        normals=cloud.normals.astype(np.float64),
        colors=cloud.colors.astype(np.float64),
    )
    found = segment_points(points, config or SegmentConfig(), robot_m)
    painted = _painted(frame, points, found.labels)
    masks = []
    for number, thing in enumerate(found.things, start=1):
        image = painted == number
        # Depth has holes, and it may be coarser than colour.
        image = ndimage.binary_fill_holes(ndimage.binary_closing(image, iterations=2) | image)
        masks.append(Mask(image=np.asarray(image), label=thing.label, score=thing.score))
    return MaskSet(
        camera_id=frame.camera_id, stamp_ns=frame.stamp_ns, masks=tuple(masks), source=SOURCE
    )


def _painted(
    frame: RgbdFrame, points: SurfacePoints, labels: Int[np.ndarray, " num_points"]
) -> Int[np.ndarray, "height width"]:
    """Label of each colour pixel: every depth pixel takes that of the trusted point beside it.

    Silhouettes have no trusted points, because their normals would mix two surfaces.
    """
    camera = frame.color_camera
    depth = np.where(np.isfinite(frame.depth_m), frame.depth_m, 0.0).astype(np.float64)
    measured = (depth > 0) & (depth < VIEW_LIMITS.max_depth_m)
    p = se3.apply(frame.T_base_depth, frame.depth_camera.unproject(depth)[measured])
    gap, nearest = cKDTree(points.p_m).query(p, distance_upper_bound=SILHOUETTE_M)
    near = np.isfinite(gap)
    near[near] = labels[nearest[near]] > 0
    p_camera = se3.apply(se3.invert(frame.T_base_color), p[near])
    uv, _ = camera.project(p_camera)
    column, row = np.floor(uv).astype(np.int64).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    painted = np.zeros((camera.height, camera.width), dtype=np.int64)
    painted[row[inside], column[inside]] = labels[nearest[near]][inside]
    return painted


def masks_from_labels(
    rasteriser: Rasteriser,
    cloud: GaussianCloud,
    labels: UInt16[np.ndarray, " num_splats"],
    names: Sequence[str],
    viewpoint: Viewpoint,
    *,
    camera_id: str = "",
    stamp_ns: int = 0,
    source: str = SOURCE,
) -> MaskSet:
    """Masks of one frame rendered from labelled Gaussians; ``names[label - 1]`` is the label.

    Things that cover less than 20 pixels are left out.
    """
    ids = render_labels(rasteriser, cloud, labels, viewpoint)
    masks = []
    for number, name in enumerate(names, start=1):
        image = ids == number
        if int(image.sum()) >= MIN_MASK_PX:
            masks.append(Mask(image=image, label=name))
    return MaskSet(camera_id=camera_id, stamp_ns=stamp_ns, masks=tuple(masks), source=source)
