"""How far many proposed poses of one thing stay from the static scene."""

import numpy as np
from jaxtyping import Float, Float32

from twin.replay.clearance.grid import GridLookup

_BATCH = 12_000
"""Points looked up at once: what fits the cache beside the grid."""


def candidate_clearance(
    lookup: GridLookup,
    points_m: Float[np.ndarray, "num_points 3"],
    Ts_base_body: Float[np.ndarray, "num_candidates 4 4"],
) -> Float32[np.ndarray, " num_candidates"]:
    """Smallest signed distance of a body's surface points, for each pose it might be released at.

    Args:
        lookup: The static scene, in the base frame.
        points_m: Points of the body's surface, in its own frame.
        Ts_base_body: The poses that are proposed.

    Returns:
        Distances [m], negative inside; a candidate is free when it is above ``eps_col_m``.
    """
    count, num = len(Ts_base_body), len(points_m)
    points = np.ascontiguousarray(points_m.T, dtype=np.float32)
    # Straight to voxels: place = R p / voxel + (t - origin) / voxel, in one product each.
    R = (Ts_base_body[:, :3, :3] / lookup.voxel_m).astype(np.float32)
    t = ((Ts_base_body[:, :3, 3] - lookup.origin_m) / lookup.voxel_m).astype(np.float32)
    nearest = np.empty(count, dtype=np.float32)
    batch = max(1, _BATCH // max(num, 1))
    for start in range(0, count, batch):
        some = slice(start, start + batch)
        rows = R[some].transpose(1, 0, 2)  # all x rows, then all y rows, then all z rows
        size = rows.shape[1]
        place = (rows.reshape(3 * size, 3) @ points).reshape(3, size, num)
        place += t[some].T[:, :, None]
        nearest[some] = lookup.at(place.reshape(3, size * num)).reshape(size, num).min(axis=1)
    return nearest
