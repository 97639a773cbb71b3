"""One instance of a segmented scene in, its shape out: for things no task file knows.

A pixel belongs to the instance when the Gaussian nearest to its measured point does.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, UInt16
from scipy.spatial import cKDTree

from bridge.geometry import se3
from twin.scene.semantics.result import Instance
from twin.scene.shape.from_training import ALIGN_ROUNDS
from twin.scene.shape.masked_view import MaskedView
from twin.scene.shape.reconstruct import ObjectShape, ShapeConfig, reconstruct
from twin.scene.training_view import TrainingView

AROUND_M = 0.015
"""Pixels this far outside of the instance's box are still asked."""
REACH_M = 0.010
"""A measured point farther than this from every Gaussian belongs to none."""


def shape_of_instance(
    views: Sequence[TrainingView],
    means_m: Float32[np.ndarray, "num_splats 3"],
    labels: UInt16[np.ndarray, " num_splats"],
    instance: Instance,
    support_z_m: float | None,
    config: ShapeConfig | None = None,
) -> ObjectShape:
    """Reconstruct an instance in the frame of its box.

    Args:
        views: What the scene was fitted to.
        means_m: Centres of the scene's Gaussians in the root frame.
        labels: Which instance each Gaussian belongs to.
        instance: The one that is wanted.
        support_z_m: Height in the root frame of what it stands on; None when it stands on
            nothing.
        config: Settings; the defaults, with six rounds of view alignment, when None.

    Raises:
        ShapeError: When the views do not suffice.
    """
    T_instance_base = se3.invert(instance.T_base_instance)
    p_instance = se3.apply(T_instance_base, means_m.astype(np.float64))
    half = np.array(instance.size_m) / 2 + AROUND_M
    near = np.flatnonzero(np.all(np.abs(p_instance) < half + REACH_M, axis=1))
    tree = cKDTree(p_instance[near]) if len(near) else None
    masked = []
    for view in views:
        target = view.full
        everything = MaskedView(
            camera=target.camera,
            T_base_camera=T_instance_base @ view.T_base_color,
            depth_m=np.where(target.static_mask, target.depth_m, np.float32(0.0)),
            mask=np.ones(target.depth_m.shape, dtype=bool),
        )
        points = everything.points_m()
        mine = np.zeros(len(points), dtype=bool)
        asked = np.flatnonzero(np.all(np.abs(points) < half, axis=1))
        if tree is not None and len(asked):
            distance, index = tree.query(points[asked], distance_upper_bound=REACH_M)
            known = np.isfinite(distance)
            mine[asked[known]] = labels[near[index[known]]] == instance.id
        mask = np.zeros(target.depth_m.shape, dtype=bool)
        mask[everything.known_depth_m() > 0] = mine
        masked.append(
            MaskedView(
                camera=everything.camera,
                T_base_camera=everything.T_base_camera,
                depth_m=everything.depth_m,
                mask=mask,
            )
        )
    support = None if support_z_m is None else support_z_m - float(instance.T_base_instance[2, 3])
    config = ShapeConfig(align_rounds=ALIGN_ROUNDS) if config is None else config
    return reconstruct([view for view in masked if view.mask.any()], support, config)
