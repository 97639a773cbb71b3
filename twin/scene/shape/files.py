"""The geometry files of one object: mesh, distances, collision parts, lattice, and their record."""

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bridge.whole_file import write_whole
from twin.scene.shape.collision import CollisionParts, collision_parts
from twin.scene.shape.lattice import lattice
from twin.scene.shape.masked_view import ShapeError
from twin.scene.shape.mass import mass_prior
from twin.scene.shape.mesh import Faces, Vertices, mesh_ply, read_mesh
from twin.scene.shape.reconstruct import ObjectShape

MESH, SDF, SOFT, COLLISION = "mesh.ply", "sdf.npz", "soft.npz", "collision"
TASK_SHAPE = "task file"
"""Source of a shape that no view and no generator gave."""


def remove_shape(folder: Path) -> None:
    """Remove what an earlier reconstruction left in an object's folder."""
    for name in (MESH, SDF, SOFT):
        (folder / name).unlink(missing_ok=True)
    if (folder / COLLISION).is_dir():
        shutil.rmtree(folder / COLLISION)


def write_shape(
    folder: Path, shape: ObjectShape, label: str, *, soft: bool
) -> tuple[list[str], dict[str, Any]]:
    """Write the geometry of one object, in the frame of its mesh.

    Args:
        folder: The object's folder, which exists.
        shape: From ``reconstruct``.
        label: What the object is called; decides the mass prior.
        soft: Whether it gets a lattice.

    Returns:
        Names of the files, and what ``object.json`` says of them.
    """
    write_whole(folder / MESH, mesh_ply(shape.vertices_m, shape.faces))
    shape.sdf.save(folder / SDF)
    parts = collision_parts(shape)
    names = [MESH, SDF, *_write_parts(folder, parts)]
    about = describe_shape(shape) | {
        "collision": {
            "num_parts": len(parts.parts),
            "hull_ratio": round(parts.hull_ratio, 4),
            "volume_ratio": round(parts.volume_ratio, 4),
            "cavity_blocked": parts.cavity_blocked,
        },
        "mass_prior": asdict(mass_prior(label, shape.volume_m3)),
    }
    if soft:
        try:
            inside = lattice(shape)
        except ShapeError as error:
            about["lattice"] = {"remark": str(error)}
        else:
            inside.save(folder / SOFT)
            names.append(SOFT)
            about["lattice"] = {
                "num_nodes": len(inside.nodes_m),
                "num_springs": len(inside.springs),
                "num_tets": len(inside.tets),
                "spacing_m": inside.spacing_m,
            }
    return names, about


def _write_parts(folder: Path, parts: CollisionParts) -> list[str]:
    (folder / COLLISION).mkdir(exist_ok=True)
    names = [f"{COLLISION}/{index:02d}.ply" for index in range(len(parts.parts))]
    for name, part in zip(names, parts.parts, strict=True):
        write_whole(folder / name, mesh_ply(part.vertices_m, part.faces))
    return names


def read_parts(folder: Path) -> list[tuple[Vertices, Faces]]:
    """Read the convex collision parts of an object: vertices [m] in its frame, and faces.

    An engine that takes arrays of vertices needs no file: the hull of each part is the part.

    Args:
        folder: ``objects/<id>`` of a scene.

    Returns:
        Nothing for an object that was not reconstructed.

    Raises:
        UnreadableMeshError: When a part is damaged.
    """
    return [read_mesh(path) for path in sorted((folder / COLLISION).glob("*.ply"))]


def describe_shape(shape: ObjectShape) -> dict[str, Any]:
    """Return the numbers of a shape as ``object.json`` holds them."""
    cavity = shape.cavity
    return {
        "watertight": shape.is_watertight,
        "volume_m3": shape.volume_m3,
        "completed_fraction": round(shape.completed_fraction, 4),
        "completed": "share of the surface no view saw; closed by the plane it stands on, or solid",
        "unseen_top_m2": shape.unseen_top_m2,
        "cavity": None
        if cavity is None
        else {"volume_m3": cavity.volume_m3, "depth_m": cavity.depth_m},
        "voxel_m": shape.sdf.voxel_m,
        "truncation_m": shape.truncation_m,
        "num_views": shape.num_views,
        "view_shift_m": shape.view_shift_m,
    }
