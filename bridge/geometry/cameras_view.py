"""What several cameras look at together, from their poses alone."""

import numpy as np
from jaxtyping import Float

LEAST_SPREAD = 1e-3
"""Optical axes this near to parallel meet nowhere."""
MOST_BEHIND = 0.1
"""Share of the cameras that may have the place behind them."""


def distance_to_what_is_seen(Ts_world_camera: Float[np.ndarray, "num_cameras 4 4"]) -> float | None:
    """Median distance of the cameras to the point that all optical axes pass nearest.

    None where the axes are parallel, or the point lies behind cameras: they look at no one place.
    """
    axes, centres = Ts_world_camera[:, :3, 2], Ts_world_camera[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.mean(axis=0)
    if np.linalg.eigvalsh(total)[0] < LEAST_SPREAD:
        return None
    point = np.linalg.solve(total, (across @ centres[:, :, None]).mean(axis=0)[:, 0])
    along = ((point - centres) * axes).sum(axis=1)
    found = float(np.median(along))
    return found if found > 0 and (along <= 0).mean() <= MOST_BEHIND else None
