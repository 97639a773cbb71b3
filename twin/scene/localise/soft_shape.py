"""How far a soft toy is deformed: its extents along the axes of its pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from twin.scene.localise.mesh import MeshFit
from twin.scene.localise.points import PointConfig, View, voxel_mean
from twin.scene.localise.soft_config import SoftConfig
from twin.scene.localise.surface import Surface, facing

STANDS = 0.9
"""Cosine of the tilt up to which the underside of a toy is taken to be level."""


@dataclass(frozen=True, kw_only=True)
class SoftShape:
    """Coarse shape: a box with its middle, axes and extents."""

    centroid_m: Float[np.ndarray, "3"]
    R_base_axes: Float[np.ndarray, "3 3"]
    extents_m: Float[np.ndarray, "3"]
    extents_sigma_m: Float[np.ndarray, "3"]

    def to_record(self) -> dict[str, list[float] | list[list[float]]]:
        """Return the entry ``soft_shape`` of a localisation record."""
        return {
            "centroid_m": self.centroid_m.tolist(),
            "axes": self.R_base_axes.T.tolist(),
            "extents_m": self.extents_m.tolist(),
            "extents_sigma_m": self.extents_sigma_m.tolist(),
        }


def soft_shape(
    views: Sequence[View],
    surface: Surface,
    model: ObjectModel,
    fit: MeshFit,
    points: PointConfig,
    soft: SoftConfig,
) -> SoftShape:
    """Extents along the axes of the fitted pose: those at rest, plus how far the seen ends moved.

    All points near the fitted surface count, whatever their colour.

    Args:
        views: What the cameras saw.
        surface: Its mesh at rest.
        model: Its extents at rest.
        fit: Where it was found.
        points: Size of the voxels.
        soft: How far the surface may be off.
    """
    T = fit.T_base_object
    T_object_base = se3.invert(T)
    above = [view.p_base[view.p_base[:, 2] > soft.min_height_m] for view in views]
    local = se3.apply(T_object_base, np.concatenate(above))
    reach = np.array(model.size_m) / 2 + soft.stretch_m
    local = voxel_mean(local[np.all(np.abs(local) < reach, axis=1)], points.voxel_m)
    distance, _ = cKDTree(surface.p_m).query(local)
    local = local[distance < soft.stretch_m]
    # An end that every camera looks at from behind was not seen; it is taken as at rest.
    eyes = se3.apply(T_object_base, np.array([view.T_base_depth[:3, 3] for view in views]))
    towards = eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    faced = np.any([facing(T_object_base, view, surface) for view in views], axis=0)
    half, ends = np.array(model.size_m) / 2, np.zeros((2, 3))
    for row, sign in enumerate((1.0, -1.0)):
        seen = (sign * towards).max(axis=0) > -0.2
        reached = np.percentile(sign * local, 98, axis=0)
        rest = np.percentile(sign * surface.p_m[faced], 98, axis=0)
        ends[row] = sign * np.maximum(half + np.where(seen, reached - rest, 0.0), 0.1 * half)
    if T[2, 2] > STANDS and T[2, 3] + ends[1, 2] < 0:
        ends[1, 2] = -T[2, 3]  # it cannot reach below the table
    sigma = np.hypot(0.005, fit.residual_m) * np.ones(3)
    return SoftShape(
        centroid_m=se3.apply(T, ends.mean(axis=0)[None])[0],
        R_base_axes=T[:3, :3].copy(),
        extents_m=ends[0] - ends[1],
        extents_sigma_m=sigma,
    )
