"""From frames to the coloured points of one object: average frames, back-project, cluster.

Diffuse shading scales linear light by one factor, so the share of each channel in the sum is a
property of the surface alone. The likeness of a pixel is 1 on the object's colour, 0 on grey.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import linear_from_srgb
from bridge.task.task_file import ObjectModel, Task
from twin.scene.frames.camera_poses import same_pose
from twin.scene.frames.downscaled import pixels_of

_LINEAR = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)


MAX_HUE_DIFFERENCE_RAD = 0.4
"""Between a pixel's hue and the object's, around the grey axis."""
MIN_LUMINANCE = 0.003
"""Darker pixels, in linear light of 0 to 1, have no dependable hue."""


def likeness(
    image_linear: Float[np.ndarray, "*batch 3"],
    color_srgb: tuple[int, int, int],
) -> Float[np.ndarray, "*batch"]:
    """Tell how much each pixel has a colour: 1 the object's chroma, 0 grey or another hue.

    An edge pixel that mixes object and grey lies between, which places edges between pixels.

    Range: 0 and up, about 1 on the object.
    """
    total = image_linear.sum(axis=-1)
    dark = total < 3 * MIN_LUMINANCE
    chroma = image_linear / np.where(dark, 1.0, total)[..., None] - 1 / 3
    wanted = _LINEAR[np.array(color_srgb)]
    wanted = wanted / wanted.sum() - 1 / 3
    strength = float(np.linalg.norm(wanted))
    along = chroma @ (wanted / strength)
    across = np.sqrt(np.maximum((chroma * chroma).sum(axis=-1) - along * along, 0.0))
    other_hue = across > along * np.tan(MAX_HUE_DIFFERENCE_RAD)
    return np.where(dark | other_hue | (along <= 0), 0.0, along / strength)


SAME_POSE_M = 5e-4
SAME_POSE_RAD = 1e-3


MIN_LIKENESS = 0.6
"""Of a point's colour, see ``likeness``."""
MIN_HEIGHT_M = 0.003
"""Above the table; lower points may be a reflection or a shadow's fringe."""
MAX_HEIGHT_M = 0.5
"""Above the table."""
MARGIN_M = 0.25
"""How far beyond its start range an object is looked for."""
VOXEL_M = 0.002
"""Points of one voxel are averaged."""
CLUSTER_GAP_M = 0.008
"""Wider gaps separate clusters."""
MIN_POINTS = 40
"""Fewer voxels than this do not make an object."""


@dataclass(frozen=True, kw_only=True)
class CameraView:
    """One camera pose: the mean of its still frames, with the points it sees."""

    camera_id: str
    stamp_ns: int
    num_frames: int
    image_linear: Float[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "depth_height depth_width"]
    color_camera: Camera
    depth_camera: Camera
    T_base_color: Float[np.ndarray, "4 4"]
    T_base_depth: Float[np.ndarray, "4 4"]
    p_base: Float[np.ndarray, "num_points 3"]
    """Points with valid depth over the searched part of the table [m]."""
    color_linear: Float[np.ndarray, "num_points 3"]
    """Linear light of each point; 0 where the colour camera does not see it."""


def fuse_stationary(
    frames: Sequence[RgbdFrame], max_frames: int, max_views: int, task: Task
) -> list[CameraView]:
    """Average the last frames of each camera that were taken from one pose.

    Frames of a camera that moved in between make separate views, the newest are kept. Depth is
    averaged over the frames that measured a pixel, if at least half of them did.
    """
    groups: list[list[RgbdFrame]] = []
    for frame in sorted(frames, key=lambda item: -item.stamp_ns):
        for group in groups:
            if (
                frame.camera_id == group[0].camera_id
                and frame.depth_m.shape == group[0].depth_m.shape
                and same_pose(
                    group[0].T_base_depth,
                    frame.T_base_depth,
                    distance_m=SAME_POSE_M,
                    angle_rad=SAME_POSE_RAD,
                )
            ):
                group.append(frame)
                break
        else:
            groups.append([frame])
    views: list[CameraView] = []
    for group in groups:
        if sum(view.camera_id == group[0].camera_id for view in views) < max_views:
            views.append(_view(group[:max_frames], task))
    return sorted(views, key=lambda view: (view.camera_id, view.stamp_ns))


def _view(frames: Sequence[RgbdFrame], task: Task) -> CameraView:
    newest = frames[0]
    depths = np.stack([frame.depth_m for frame in frames]).astype(np.float64)
    measured = np.isfinite(depths) & (depths > 0)
    count = measured.sum(axis=0)
    depth = np.where(measured, depths, 0.0).sum(axis=0) / np.maximum(count, 1)
    depth[2 * count < len(frames)] = 0.0
    image = np.mean([_LINEAR[frame.image_u8] for frame in frames], axis=0)
    p_base = se3.apply(newest.T_base_depth, newest.depth_camera.unproject(depth)[depth > 0])
    p_base = p_base[_in_search_area(p_base, task)]
    p_color = se3.apply(se3.invert(newest.T_base_color), p_base)
    row, column, inside = pixels_of(newest.color_camera, p_color)
    color_linear = np.zeros_like(p_base)
    color_linear[inside] = image[row[inside], column[inside]]
    return CameraView(
        camera_id=newest.camera_id,
        stamp_ns=newest.stamp_ns,
        num_frames=len(frames),
        image_linear=image,
        depth_m=depth,
        color_camera=newest.color_camera,
        depth_camera=newest.depth_camera,
        T_base_color=newest.T_base_color,
        T_base_depth=newest.T_base_depth,
        p_base=p_base,
        color_linear=color_linear,
    )


def moved(view: CameraView, T_new_old: Float[np.ndarray, "4 4"], depth_factor: float) -> CameraView:
    """The same view with its cameras moved in the base frame and its depth scaled."""
    T_base_depth = T_new_old @ view.T_base_depth
    p_depth = se3.apply(se3.invert(view.T_base_depth), view.p_base) * depth_factor
    return replace(
        view,
        depth_m=view.depth_m * depth_factor,
        T_base_color=T_new_old @ view.T_base_color,
        T_base_depth=T_base_depth,
        p_base=se3.apply(T_base_depth, p_depth),
    )


def _in_search_area(
    p_base: Float[np.ndarray, "num_points 3"], task: Task
) -> Bool[np.ndarray, " num_points"]:
    """Points over the part of the table where any object of the task may be."""
    wanted: Bool[np.ndarray, " num_points"] = np.abs(p_base[:, 2]) < MAX_HEIGHT_M
    starts = task.start.values()
    for axis, limits in enumerate(([s.x_m for s in starts], [s.y_m for s in starts])):
        if limits:
            low = min(limit[0] for limit in limits) - MARGIN_M
            high = max(limit[1] for limit in limits) + MARGIN_M
            wanted &= (p_base[:, axis] >= low) & (p_base[:, axis] <= high)
    return wanted


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """Points that belong together, and the view each came from."""

    p_base: Float[np.ndarray, "num_points 3"]
    view_ids: Int[np.ndarray, " num_points"]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.p_base)

    def thinned(self, max_points: int) -> "Cluster":
        """Keep every so many points, evenly."""
        step = -(-len(self) // max_points) if len(self) else 1
        return Cluster(p_base=self.p_base[::step], view_ids=self.view_ids[::step])

    def by_view(self, num_views: int) -> list[Float[np.ndarray, "_ 3"]]:
        """Return the points of each view."""
        return [self.p_base[self.view_ids == view_id] for view_id in range(num_views)]


def object_points(
    views: Sequence[CameraView],
    model: ObjectModel,
    min_height_m: float = MIN_HEIGHT_M,
    is_other: Callable[[np.ndarray], np.ndarray] = lambda p: np.zeros(len(p), dtype=bool),
) -> list[Cluster]:
    """Clusters of voxel-averaged points of an object's colour, largest first.

    Args:
        is_other: Which points belong to something else, whatever their colour.
    """
    parts = [np.zeros((0, 3))]
    for view in views:
        p = view.p_base
        wanted = p[:, 2] > min_height_m
        p, color = p[wanted], view.color_linear[wanted]
        alike = likeness(color, model.color_srgb) >= MIN_LIKENESS
        mean = voxel_mean(p[alike], VOXEL_M)
        parts.append(mean[~is_other(mean)])
    view_ids = np.repeat(np.arange(len(views)), [len(part) for part in parts[1:]])
    return clusters(np.concatenate(parts), view_ids, CLUSTER_GAP_M)


def voxel_mean(
    points: Float[np.ndarray, "num_points 3"], voxel_m: float
) -> Float[np.ndarray, "num_voxels 3"]:
    """Replace the points of each occupied voxel by their mean."""
    if len(points) == 0:
        return points
    keys = np.floor(points / voxel_m).astype(np.int64)
    keys -= keys.min(axis=0)
    spans = keys.max(axis=0) + 1
    flat = (keys[:, 0] * spans[1] + keys[:, 1]) * spans[2] + keys[:, 2]
    _, index, count = np.unique(flat, return_inverse=True, return_counts=True)
    sums = [np.bincount(index, weights=points[:, axis]) for axis in range(3)]
    return np.stack(sums, axis=1) / count[:, None]


def clusters(
    points: Float[np.ndarray, "num_points 3"],
    view_ids: Int[np.ndarray, " num_points"],
    gap_m: float,
) -> list[Cluster]:
    """Connected groups seen from above, largest first."""
    if len(points) == 0:
        return []
    cells = np.floor(points[:, :2] / (gap_m / 2)).astype(np.int64)
    cells -= cells.min(axis=0)
    grid = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    grid[cells[:, 0], cells[:, 1]] = True
    near = ndimage.binary_dilation(grid, structure=np.ones((3, 3), dtype=bool))
    labels, num = ndimage.label(near, structure=np.ones((3, 3), dtype=np.int64))
    label_of_point = labels[cells[:, 0], cells[:, 1]]
    groups = [
        Cluster(p_base=points[label_of_point == label], view_ids=view_ids[label_of_point == label])
        for label in range(1, num + 1)
    ]
    return sorted(groups, key=lambda group: -len(group))
