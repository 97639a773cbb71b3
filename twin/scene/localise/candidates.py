"""Clusters of points that may be one soft toy each."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from twin.scene.localise.colour import ColourConfig, likeness
from twin.scene.localise.points import Cluster, PointConfig, View, clusters, voxel_mean
from twin.scene.localise.soft_config import SoftConfig
from twin.scene.localise.surface import known_surface
from twin.scene.shape.known import surface_distances

DENSE_SAMPLES = 20_000
CELL_M = 0.004


def candidates(
    model: ObjectModel,
    count: int,
    views: Sequence[View],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
    points: PointConfig,
    colour: ColourConfig,
    soft: SoftConfig,
) -> list[Cluster]:
    """Clusters that may be one toy each; what touches is cut apart.

    Args:
        model: The toy.
        count: How many equal ones there are at most.
        views: What the cameras saw.
        blocked: Rigid objects with their poses; their points do not count.
        points: Which points count.
        colour: Which pixels have the toy's colour.
        soft: Heights and sizes.
    """
    parts = []
    for view in views:
        p = view.p_base
        alike = p[:, 2] > soft.min_height_m
        alike[alike] = likeness(view.color_linear[alike], model.color_srgb, colour) >= (
            points.min_likeness
        )
        p = voxel_mean(p[alike], points.voxel_m)
        parts.append(p[~_on_others(p, blocked, soft.clear_m)])
    ids = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    everything = np.concatenate(parts) if parts else np.zeros((0, 3))
    single = []
    for group in clusters(everything, ids, points.cluster_gap_m):
        if len(group) < points.min_points:
            continue
        for piece in _cut(group, model, count, soft):
            extent = np.ptp(np.percentile(piece.p_base, [2, 98], axis=0), axis=0).max()
            if len(piece) >= points.min_points and extent > soft.shrink * min(model.size_m):
                single.append(piece)
    return single


def _on_others(
    p: Float[np.ndarray, "num_points 3"],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
    clear_m: float,
) -> Bool[np.ndarray, " num_points"]:
    mask = np.zeros(len(p), dtype=bool)
    for model, T in blocked.items():
        if model.mesh is None:
            distance, _ = surface_distances(p, model, T)
            mask |= np.abs(distance) < clear_m
        elif len(p):
            surface = se3.apply(T, known_surface(model, DENSE_SAMPLES).p_m)
            distance, _ = cKDTree(surface).query(p, distance_upper_bound=clear_m)
            mask |= np.isfinite(distance)
    return mask


def _cut(group: Cluster, model: ObjectModel, count: int, soft: SoftConfig) -> list[Cluster]:
    """Cut a cluster that is too large for one toy into as many as would cover its area."""
    low, high = np.percentile(group.p_base[:, :2], [1, 99], axis=0)
    if float(np.linalg.norm(high - low)) <= soft.growth * float(np.linalg.norm(model.size_m[:2])):
        return [group]
    cells = np.unique(np.floor(group.p_base[:, :2] / CELL_M).astype(np.int64), axis=0)
    one = soft.fill * model.size_m[0] * model.size_m[1]
    number = round(len(cells) * CELL_M**2 / one)
    if not 2 <= number <= count:
        return []
    _, labels = kmeans2(group.p_base, number, minit="++", seed=0)
    return [
        Cluster(p_base=group.p_base[labels == label], view_ids=group.view_ids[labels == label])
        for label in range(number)
    ]
