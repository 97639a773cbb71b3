"""The geometry files of one object: mesh, distances, lattice, and their record."""

from pathlib import Path
from typing import Any

from bridge.whole_file import write_whole
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.lattice import lattice
from twin.scene.shape.mesh import mesh_ply
from twin.scene.shape.reconstruct import ObjectShape

MESH, SDF, SOFT = "mesh.ply", "sdf.npz", "soft.npz"
TASK_SHAPE = "task file"
"""Source of a shape that no view gave."""


def write_shape(
    folder: Path, shape: ObjectShape, *, soft: bool
) -> tuple[list[str], dict[str, Any]]:
    """Write the geometry of one object, in the frame of its mesh."""
    write_whole(folder / MESH, mesh_ply(shape.vertices_m, shape.faces))
    shape.sdf.save(folder / SDF)
    names = [MESH, SDF]
    about: dict[str, Any] = {
        "watertight": shape.is_watertight,
        "volume_m3": shape.volume_m3,
        "voxel_m": shape.sdf.voxel_m,
        "truncation_m": shape.truncation_m,
        "num_views": shape.num_views,
    }
    if soft:
        try:
            inside = lattice(shape)
        except ShapeError as error:
            about["lattice"] = {"remark": str(error)}
        else:
            inside.save(folder / SOFT)
            names.append(SOFT)
    return names, about
