"""How a soft body is handed to the native solver: masses, damping, where contact is looked for."""

import numpy as np
from jaxtyping import Float, Int32

from bridge.geometry import se3
from twin.physics._soft import SoftSolver as SoftSolver
from twin.physics.soft import SoftModel

LEAST_MASS = 0.4
"""Nodes get at least this share of the mean node's mass: a light corner would be the stiffest."""

CRITICAL = 2.0
"""The slowest deformation is damped at most critically: at twice its frequency. The viscosity of
single tetrahedra reaches only short waves: one visit in each substep is too few for long ones."""


def add_body(
    solver: SoftSolver,
    model: SoftModel,
    T_base_object: Float[np.ndarray, "4 4"],
    *,
    young_pa: float,
    friction: float,
) -> tuple[int, Float[np.ndarray, " num_nodes"]]:
    """Hand a body at rest to a solver.

    Args:
        solver: Takes it.
        model: Shape and mass.
        T_base_object: Where its object frame is.
        young_pa: Young's modulus.
        friction: Its own coefficient.

    Returns:
        The solver's number for it, and the masses of its nodes [kg].
    """
    rest, surface = model.nodes_m.astype(np.float64), model.surface()
    masses, omega = _node_masses(model), model.slowest_mode_rad_s()
    index = solver.add_body(
        se3.apply(T_base_object, rest),
        rest,
        np.ascontiguousarray(model.tets),
        masses,
        _samples(surface),
        np.ascontiguousarray(surface),
        young_pa,
        model.poisson,
        model.damping_s,
        min(model.damping_s * omega**2, CRITICAL * omega),
        friction,
        model.spacing_m,
    )
    return int(index), masses


def _node_masses(model: SoftModel) -> Float[np.ndarray, " num_nodes"]:
    share = model.mass_fraction.astype(np.float64)
    share = np.maximum(share / share.sum(), LEAST_MASS / len(share))
    return np.asarray(model.mass_kg * share / share.sum())


def _samples(triangles: Int32[np.ndarray, "num_triangles 3"]) -> Int32[np.ndarray, "num_samples 2"]:
    """Where contact is looked for: surface nodes, and middles of surface edges."""
    nodes = np.unique(triangles)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    return np.ascontiguousarray(
        np.concatenate([np.stack([nodes, nodes], axis=1), edges]), dtype=np.int32
    )
