"""Soft objects in MuJoCo: trilinear flexes, and what their cages say about pose and shape.

A flex with ``dof="trilinear"`` has eight nodes at the corners of the box around it; each is a body
with three slide joints along the world axes. Everything inside follows by trilinear interpolation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bridge.sources.standin.cell_file import HiddenParameters
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.meshes.lattice import CORNERS, make_lattice
from bridge.task.task_file import ObjectModel, Task

FLEX_RADIUS_M = 0.0005
"""Of the tetrahedra: keeps neighbouring contacts from jumping as faces slide over edges."""
FLEX_SOLREF = (0.008, 1.0)


def soft_model_xml(task: Task, hidden: HiddenParameters) -> str:
    """Return a MuJoCo model with nothing but the task's soft objects, each at its own origin."""
    bodies = "".join(
        _flex_xml(model, hidden) for model in task.objects.values() if model.soft is not None
    )
    return f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"


def _flex_xml(model: ObjectModel, hidden: HiddenParameters) -> str:
    soft = model.soft
    if soft is None:
        return ""
    lattice = make_lattice(object_mesh(model), soft.cell_m)
    young = soft.young_pa * (1.0 if hidden.stiffness_scale is None else hidden.stiffness_scale)
    points = " ".join(repr(float(value)) for value in lattice.points_m.ravel())
    elements = " ".join(str(int(value)) for value in lattice.tetrahedra.ravel())
    return (
        f'<body name="{model.id}"><flexcomp name="{model.id}" type="direct" dim="3" '
        f'dof="trilinear" radius="{FLEX_RADIUS_M}" mass="{model.mass_kg * hidden.mass_scale!r}" '
        f'point="{points}" element="{elements}">'
        f'<elasticity young="{young!r}" poisson="{soft.poisson}" damping="{soft.damping_s}"/>'
        f'<contact contype="2" conaffinity="3" condim="4" priority="1" selfcollide="none" '
        f'friction="{hidden.object_friction!r} 0.005 0.0001" '
        f'solref="{FLEX_SOLREF[0]} {FLEX_SOLREF[1]}"/>'
        "</flexcomp></body>"
    )


@dataclass(frozen=True, kw_only=True)
class SoftBody:
    """Where the nodes of one soft object are kept, and how it is shaped at rest."""

    body_ids: Int[np.ndarray, "8"]
    """Bodies of the nodes, in the order of ``CORNERS``."""
    addresses: Int[np.ndarray, "8 3"]
    """Of their slide joints in qpos."""
    rest_nodes_m: Float[np.ndarray, "8 3"]
    """In the object frame."""
    skin_weights: Float[np.ndarray, "num_vertices 8"]
    """From the nodes to the vertices of the object's mesh."""
    lattice_weights: Float[np.ndarray, "num_points 8"]
    """From the nodes to the points of the lattice."""


def soft_body(model: ObjectModel, mujoco_model: Any) -> SoftBody:
    """Find the nodes of a soft object in a compiled model."""
    if model.soft is None:
        message = f"{model.id} is not soft"
        raise ValueError(message)
    mesh = object_mesh(model)
    lattice = make_lattice(mesh, model.soft.cell_m)
    low, high = lattice.points_m.min(axis=0), lattice.points_m.max(axis=0)
    ids = [int(mujoco_model.body(f"{model.id}_{i}_{j}_{k}").id) for i, j, k in CORNERS]
    joints = [int(mujoco_model.body_jntadr[body]) + np.arange(3) for body in ids]
    return SoftBody(
        body_ids=np.array(ids),
        addresses=np.array([mujoco_model.jnt_qposadr[three] for three in joints]).astype(np.int64),
        rest_nodes_m=cage_nodes(low, high),
        skin_weights=cage_weights(mesh.vertices_m, low, high),
        lattice_weights=cage_weights(lattice.points_m, low, high),
    )


def cage_nodes(
    low_m: Float[np.ndarray, "3"], high_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "8 3"]:
    """Corners of a box in the order of ``CORNERS``: z runs fastest."""
    return np.asarray(low_m + np.array(CORNERS, dtype=np.float64) * (high_m - low_m))


def cage_weights(
    points_m: Float[np.ndarray, "num_points 3"],
    low_m: Float[np.ndarray, "3"],
    high_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "num_points 8"]:
    """Trilinear weights: ``weights @ nodes`` moves points; outside the box they extrapolate."""
    s = (points_m - low_m) / (high_m - low_m)
    columns = [
        np.prod([s[:, k] if corner[k] else 1.0 - s[:, k] for k in range(3)], axis=0)
        for corner in CORNERS
    ]
    return np.stack(columns, axis=1)
