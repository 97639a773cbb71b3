"""Perturbed final states, Eq. 8 and 9 of the paper, with what it leaves open decided and written.

The position moves by a vector uniform in a box. The paper bounds the rotation vector and says
neither how it is drawn nor in which frame; here its axis is uniform on the sphere, its angle
uniform in [0, tau_r], and it turns the tool in the tool's own frame (errata, resolution 7).
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3

ROTATION = "axis uniform on the sphere, angle uniform in [0, tau_r], in the end-effector frame"
TRANSLATION = "uniform in [-tau_p, tau_p] along each axis of the base frame"


def perturbed(
    T_base_tcp: Float[np.ndarray, "4 4"],
    *,
    tau_p_m: float,
    tau_r_rad: float,
    count: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "count 4 4"]:
    """Draw end-effector poses around a nominal one.

    Args:
        T_base_tcp: The nominal pose.
        tau_p_m: Most of the shift along each axis.
        tau_r_rad: Most of the turn.
        count: How many.
        rng: Where they come from.
    """
    shift = rng.uniform(-tau_p_m, tau_p_m, (count, 3))
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turn = axis * rng.uniform(0.0, tau_r_rad, (count, 1))
    T = np.repeat(T_base_tcp[None], count, axis=0)
    T[:, :3, :3] = T[:, :3, :3] @ se3.rotation_from_vector(turn)
    T[:, :3, 3] += shift
    return T


def sampling_record(tau_p_m: float, tau_r_rad: float, seed: int) -> dict[str, Any]:
    """Say how final states were drawn, for the log of a plan.

    Args:
        tau_p_m: Bound of the shift.
        tau_r_rad: Bound of the turn.
        seed: Of the draws.
    """
    return {
        "tau_p_m": tau_p_m,
        "tau_r_rad": tau_r_rad,
        "translation": TRANSLATION,
        "rotation": ROTATION,
        "seed": seed,
    }
