"""Tetrahedra inside a reconstructed shape, for soft bodies."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bridge.errors import UsageError
from bridge.task.meshes.lattice import fill, volumes_m3
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.sdf import SdfGrid

SPACING_M = 0.009
"""Distance of neighbouring nodes, at most."""


def lattice(shape: SdfGrid) -> dict[str, np.ndarray]:
    """Fill a shape as the bodies of tasks are filled; of what hangs apart, the largest piece.

    Returns:
        ``nodes_m``, ``tets`` (four nodes each, of positive volume), each node's ``mass_fraction``
        (by the volume around it) and ``spacing_m``.

    Raises:
        ShapeError: When it is thinner than a cube of the lattice.
    """
    message = f"no lattice of {SPACING_M * 1e3:.1f} mm fits into the shape: choose a finer one."
    inside = np.argwhere(shape.values_m < 0)
    if not len(inside):
        raise ShapeError(message)
    p = shape.origin_m + shape.voxel_m * inside
    depth_m = -shape.values_m[tuple(inside.T)][:, None]
    low, high = (p - depth_m).min(axis=0), (p + depth_m).max(axis=0)
    try:
        filled = fill(shape.distance, low, high, SPACING_M)
    except UsageError as error:
        raise ShapeError(message) from error
    nodes, tets = filled.points_m, filled.tetrahedra
    links = (np.ones(3 * len(tets)), (np.repeat(tets[:, 0], 3), tets[:, 1:].ravel()))
    _, piece = connected_components(coo_array(links, shape=(len(nodes), len(nodes))))
    kept = tets[piece[tets[:, 0]] == np.bincount(piece).argmax()]
    used, index = np.unique(kept, return_inverse=True)
    nodes, tets = nodes[used], index.reshape(-1, 4)
    shares = np.zeros(len(nodes))
    np.add.at(shares, tets, np.abs(volumes_m3(nodes, tets))[:, None] / 4)
    return {
        "nodes_m": nodes.astype(np.float32),
        "tets": tets.astype(np.int32),
        "mass_fraction": (shares / shares.sum()).astype(np.float32),
        "spacing_m": np.array(SPACING_M),
    }
