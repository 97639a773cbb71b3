"""Meshes by name and size: centred, scaled, painted; made once per process."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from bridge.errors import UsageError
from bridge.task.meshes.solids import Distances, Points, Solid, mesh_of
from bridge.task.meshes.toys import DESIGNS, Design, Paint, basket_design
from bridge.task.task_file import BASKET, ObjectModel


@dataclass(frozen=True, kw_only=True)
class ToyMesh:
    """A closed surface in the frame of its object, with paint."""

    vertices_m: Float[np.ndarray, "num_vertices 3"]
    triangles: Int[np.ndarray, "num_triangles 3"]
    """Counter-clockwise seen from outside."""
    paint: Paint
    """Colour of any point of the undeformed surface; finer than the triangles."""
    solid: Solid
    """Signed distance estimate in the same frame."""


def toy_mesh(name: str, size_m: tuple[float, float, float]) -> ToyMesh:
    """Make one of the toys, by its name in ``toys.DESIGNS``."""
    design = DESIGNS.get(name)
    if design is None:
        message = f"no mesh named {name!r}. There are: {', '.join(sorted([*DESIGNS, BASKET]))}."
        raise UsageError(message)
    return scaled_mesh(design, size_m)


@cache
def scaled_mesh(design: Design, size_m: tuple[float, float, float]) -> ToyMesh:
    """Scale what is drawn to its outer extents, the origin at their middle."""
    vertices, triangles = mesh_of(design.solid, design.low_m, design.high_m, design.spacing_m)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, scale = (low + high) / 2, np.array(size_m) / (high - low)

    def natural(p: Points) -> Points:
        return np.asarray(p / scale + middle)

    def paint(p: Points) -> Points:
        return design.paint(natural(p))

    def solid(p: Points) -> Distances:
        return np.asarray(design.solid(natural(p)) * float(np.cbrt(np.prod(scale))))

    return ToyMesh(
        vertices_m=(vertices - middle) * scale, triangles=triangles, paint=paint, solid=solid
    )


@cache
def basket_mesh(inner_m: tuple[float, float, float], wall_m: float) -> ToyMesh:
    """Make a basket around a cavity; the origin is under the middle of the floor."""
    design = basket_design(inner_m, wall_m)
    vertices, triangles = mesh_of(design.solid, design.low_m, design.high_m, design.spacing_m)
    return ToyMesh(vertices_m=vertices, triangles=triangles, paint=design.paint, solid=design.solid)


def object_mesh(model: ObjectModel) -> ToyMesh:
    """Make the mesh of an object of a task whose shape is ``mesh``."""
    if model.mesh is None:
        raise UsageError(f"{model.id} is a {model.shape}, not a mesh: its panels() are its shape.")
    if model.mesh == BASKET:
        return basket_mesh(model.inner_m, model.wall_m)
    return toy_mesh(model.mesh, model.size_m)
