"""Table that nobody saw, under objects that were taken out: filled in, and said so.

The colour is the distance-weighted mean of the table around. It keeps renders free of black
holes when an object moves; it is a guess and is counted apart in ``scene.json``.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from twin.scene.gaussians.cloud import GaussianCloud, as_float32
from twin.scene.objects.remains import HALO_M

SPACING_M = 0.004
GROWN_M = HALO_M + 0.003
"""How far beyond the footprint holes are looked for: what is dropped reaches to the halo."""
TABLE_M = 0.008
"""Gaussians this near z = 0 are table."""
NEIGHBOURS = 12
OPACITY_LOGIT = 3.0


def fill_footprint(
    background: GaussianCloud, model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]
) -> GaussianCloud:
    """Flat Gaussians on the table wherever the background leaves a hole under an object.

    Args:
        background: The scene without the object.
        model: Its footprint.
        T_base_object: Where it stood.

    Returns:
        The filling alone; empty where the table was seen, or where none is around.
    """
    half = np.array(model.size_m[:2]) / 2 + GROWN_M
    steps = [np.arange(-h, h + SPACING_M / 2, SPACING_M) for h in half]
    local = np.stack([*np.meshgrid(*steps), np.zeros((len(steps[1]), len(steps[0])))], axis=-1)
    xy = se3.apply(T_base_object, local.reshape(-1, 3))[:, :2]
    means = background.means_m.astype(np.float64)
    reach = float(np.linalg.norm(half)) + 0.03
    near = np.linalg.norm(means[:, :2] - T_base_object[:2, 3], axis=1) < reach
    table = np.flatnonzero(near & (np.abs(means[:, 2]) < TABLE_M))
    if len(table) < NEIGHBOURS:
        return background.take(np.zeros(0, dtype=np.int64))
    distance, ids = cKDTree(means[table, :2]).query(xy, k=NEIGHBOURS)
    holes = distance[:, 0] > SPACING_M
    weight = 1.0 / distance[holes] ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    around = table[ids[holes]]
    count = int(holes.sum())
    scales = np.log([0.75 * SPACING_M, 0.75 * SPACING_M, 0.1 * SPACING_M])
    z = (weight * means[around, 2]).sum(axis=1)
    colors = (weight[..., None] * background.colors[around]).sum(axis=1)
    return GaussianCloud(
        means_m=as_float32(np.column_stack([xy[holes], z])),
        quats_wxyz=as_float32(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))),
        scales_log=as_float32(np.tile(scales, (count, 1))),
        opacities_logit=as_float32(np.full(count, OPACITY_LOGIT)),
        colors=as_float32(colors),
    )
