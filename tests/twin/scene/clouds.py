"""Gaussians of one size where they are wanted, and any others in a box."""

from collections.abc import Sequence

import numpy as np

from twin.scene.gaussians import GaussianCloud, as_float32


def even_cloud(
    points_m: np.ndarray, colors: object, radius_m: float | np.ndarray = 0.002, logit: float = 4.0
) -> GaussianCloud:
    count = len(points_m)
    return GaussianCloud(
        means_m=as_float32(points_m),
        quats_wxyz=as_float32(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))),
        scales_log=as_float32(np.full((count, 3), np.log(radius_m))),
        opacities_logit=as_float32(np.full(count, logit)),
        colors=as_float32(np.broadcast_to(np.asarray(colors), (count, 3))),
    )


def any_cloud(
    seed: int,
    count: int,
    box: Sequence[np.ndarray | list[float]],
    sizes: tuple[float, float],
    **more: float,
) -> GaussianCloud:
    """Of ``more``: mean and deviation of opacities, of harmonics deviation and number."""
    rng, harmonics = np.random.default_rng(seed), int(more.get("harmonics", 0))
    return GaussianCloud(
        means_m=as_float32(rng.uniform(*box, size=(count, 3))),
        quats_wxyz=as_float32(rng.normal(size=(count, 4))),
        scales_log=as_float32(np.log(rng.uniform(*sizes, size=(count, 3)))),
        opacities_logit=as_float32(rng.normal(more.get("mean", 0), more.get("spread", 1), count)),
        colors=as_float32(rng.uniform(size=(count, 3))),
        harmonics=as_float32(rng.normal(scale=more.get("shine", 0.1), size=(count, harmonics, 3))),
    )
