"""Neighbours of one colour belong together: shares diffused over the surface."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from twin.scene.gaussians.cloud import GaussianCloud, as_float32
from twin.scene.semantics.colour import lab_from_srgb, without_shading


@dataclass(frozen=True, kw_only=True)
class SmoothConfig:
    """How far and across what shares spread."""

    num_neighbours: int = 12
    """Of each Gaussian."""
    num_steps: int = 8
    """Of diffusion; an edge moves by about the square root of it in spacings."""
    colour_gap: float = 9.0
    """Lab distance across which nothing spreads."""
    keep: float = 0.1
    """What a Gaussian was told weighs at least against its neighbours, each step."""
    lightness_weight: float = 0.3
    """Shading is no edge."""


def smooth_shares(
    share: Float32[np.ndarray, "num_things num_splats"], cloud: GaussianCloud, config: SmoothConfig
) -> Float32[np.ndarray, "num_things num_splats"]:
    """Let neighbours of one colour agree whose they are.

    Masks bleed and shrink at random; the edge of a colour is where a thing ends. Gaussians near
    any mask take part, all others keep their share of zero.
    """
    told = np.flatnonzero(share.max(axis=0, initial=0.0) > 0.01)
    if len(told) <= config.num_neighbours:
        return share
    lab = lab_from_srgb(cloud.colors)
    colour = without_shading(lab, config.lightness_weight)
    p = cloud.means_m.astype(np.float64)
    gap, near = cKDTree(p).query(p[told], k=config.num_neighbours + 1)
    reach = np.median(gap[:, -1])
    different = np.linalg.norm(colour[told][:, None] - colour[near], axis=2)
    weight = np.exp(-0.5 * (gap / reach) ** 2 - 0.5 * (different / config.colour_gap) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(told)), near.shape[1])
    spread = csr_matrix((weight.ravel(), (rows, near.ravel())), shape=(len(told), len(p)))
    state = share.astype(np.float64).T
    first = state[told].copy()
    # Frames that agree are believed; where they do not, the neighbours decide.
    agreed = np.abs(2.0 * first.max(axis=1, keepdims=True) - 1.0) ** 2
    keep = np.maximum(config.keep, agreed)
    for _ in range(config.num_steps):
        state[told] = keep * first + (1.0 - keep) * (spread @ state)
    return as_float32(state.T)
