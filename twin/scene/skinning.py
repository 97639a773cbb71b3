"""Gaussians that follow a soft body: linear-blend skinning from the nodes of its lattice.

Each Gaussian blends the rigid motions of its eight nearest nodes. A node's rotation is the polar
factor of how its neighbourhood moved; Gaussians keep their size, they only move and turn.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import cKDTree

from bridge.geometry import se3
from twin.errors import TwinError
from twin.scene.gaussians import GaussianCloud, as_float32, turned_quats
from twin.scene.harmonics import turned_harmonics

NUM_NODES = 8
"""Nodes that move one Gaussian."""
NUM_NEIGHBOURS = 12
"""Nodes around a node that say how it turned."""
BODY_SHARE = 0.05
"""Weight of the whole body's rotation beside a node's neighbourhood: neighbours in one plane leave
a turn open."""


class SkinError(TwinError):
    """Gaussians cannot be bound to these nodes, or moved by them."""


@dataclass(frozen=True, kw_only=True)
class Binding:
    """Which nodes move which Gaussians."""

    weights: sparse.csr_array
    """One row per Gaussian, ``NUM_NODES`` entries that sum to 1, one column per node."""
    rest_nodes_m: Float[np.ndarray, "num_nodes 3"]
    neighbours: Int[np.ndarray, "num_nodes num_neighbours"]


def bind(
    points_m: Float[np.ndarray, "num_points 3"], nodes_m: Float[np.ndarray, "num_nodes 3"]
) -> Binding:
    """Bind points to the nodes nearest to them, both at rest and in one frame.

    A weight falls to zero where the ninth node becomes as near, so that it changes smoothly from
    point to point.
    """
    nodes = np.asarray(nodes_m, dtype=np.float64)
    if len(nodes) <= NUM_NODES + 1:
        message = (
            f"a body of {len(nodes)} nodes: skinning takes {NUM_NODES + 2} or more. Choose a finer "
            "lattice."
        )
        raise SkinError(message)
    tree = cKDTree(nodes)
    distance, ids = tree.query(np.asarray(points_m, dtype=np.float64), k=NUM_NODES + 1)
    raw = (1.0 - distance[:, :NUM_NODES] / np.maximum(distance[:, NUM_NODES:], 1e-12)) ** 2
    raw[:, 0] += 1e-9  # nine nodes equally far
    raw /= raw.sum(axis=1, keepdims=True)
    starts = np.arange(len(points_m) + 1) * NUM_NODES
    weights = sparse.csr_array(
        (raw.ravel(), ids[:, :NUM_NODES].ravel(), starts), shape=(len(points_m), len(nodes))
    )
    _, around = tree.query(nodes, k=min(NUM_NEIGHBOURS + 1, len(nodes)))
    return Binding(weights=weights, rest_nodes_m=nodes, neighbours=around[:, 1:])


def pose_cloud(
    cloud: GaussianCloud, binding: Binding, nodes_m: Float[np.ndarray, "num_nodes 3"]
) -> GaussianCloud:
    """Move Gaussians with the nodes they are bound to.

    A rigid motion of all nodes moves and turns every Gaussian by it. Rotations are blended as
    quaternions (Kavan et al. 2007 without the dual part), colours turn along.
    """
    rest, nodes = binding.rest_nodes_m, np.asarray(nodes_m, dtype=np.float64)
    if len(cloud) != binding.weights.shape[0] or nodes.shape != rest.shape:
        message = (
            f"{len(cloud)} Gaussians and {len(nodes)} nodes do not fit a binding of "
            f"{binding.weights.shape[0]} and {len(rest)}. Bind them again."
        )
        raise SkinError(message)
    if not np.isfinite(nodes).all():
        message = "nodes that are no numbers cannot move Gaussians: the soft body burst."
        raise SkinError(message)
    R = node_rotations(rest, nodes, binding.neighbours)
    q = se3.quaternion_from_rotation(R)
    q *= np.where(q @ q[0] < 0, -1.0, 1.0)[:, None]
    t = nodes - np.einsum("nij,nj->ni", R, rest)
    blended = binding.weights @ np.concatenate([R.reshape(-1, 9), t, q], axis=1)
    A, shift, turn = blended[:, :9].reshape(-1, 3, 3), blended[:, 9:12], blended[:, 12:]
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    means = np.einsum("nij,nj->ni", A, cloud.means_m.astype(np.float64)) + shift
    return replace(
        cloud,
        means_m=as_float32(means),
        quats_wxyz=as_float32(turned_quats(turn, cloud.quats_wxyz)),
        harmonics=turned_harmonics(cloud.harmonics, se3.rotation_from_quaternion(turn)),
    )


def node_rotations(
    rest_m: Float[np.ndarray, "num_nodes 3"],
    nodes_m: Float[np.ndarray, "num_nodes 3"],
    neighbours: Int[np.ndarray, "num_nodes num_neighbours"],
) -> Float[np.ndarray, "num_nodes 3 3"]:
    """Rotation of each node: the polar factor of its neighbourhood's motion.

    The nearest rotation in the sense of least squares (Kabsch 1976), with the body's own rotation
    as a weak prior.
    """
    arms_rest = rest_m[neighbours] - rest_m[:, None]
    arms = nodes_m[neighbours] - nodes_m[:, None]
    cross = np.einsum("nka,nkb->nab", arms, arms_rest)
    body = se3.nearest_rotation(cross.sum(axis=0)[None])[0]
    size = np.einsum("nka,nka->n", arms_rest, arms_rest)
    return se3.nearest_rotation(cross + BODY_SHARE * size[:, None, None] * body)
