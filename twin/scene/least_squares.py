"""Robust least squares: Tukey's weights and the normal equations of one Gauss-Newton step."""

import numpy as np
from jaxtyping import Float


def tukey_weights(
    residuals: Float[np.ndarray, " num_residuals"], bound: float
) -> Float[np.ndarray, " num_residuals"]:
    """Biweights (Beaton and Tukey 1974): 1 at zero, 0 from the bound on."""
    return np.asarray(np.maximum(1.0 - np.square(residuals / bound), 0.0) ** 2)


def normal_equations(
    J: Float[np.ndarray, "num_residuals num_unknowns"],
    residuals: Float[np.ndarray, " num_residuals"],
    weights: Float[np.ndarray, " num_residuals"],
) -> tuple[Float[np.ndarray, "num_unknowns num_unknowns"], Float[np.ndarray, " num_unknowns"]]:
    """Return J^T W J and the gradient J^T W r; a step solves H x = -gradient."""
    weighted = (J * weights[:, None]).T
    return weighted @ J, weighted @ residuals
