"""Objects as parts of their own: their Gaussians taken out of the scene, and their mesh.

The scene is the background plus objects in their own frames, so an object can be put anywhere.
Gaussians are cut along the reconstructed shape (``owners``). The mesh is reconstructed from the
views where they allow it; otherwise it is the known shape of the task file, and ``shape_source``
says so.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import provenance
from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import ObjectModel, Task
from bridge.whole_file import write_whole
from twin.scene.gaussians.cloud import GaussianCloud, concatenate
from twin.scene.gaussians.moved import moved_cloud
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects.fill import fill_footprint
from twin.scene.objects.owners import SplitConfig, object_poses, owners
from twin.scene.objects.remains import hidden_table
from twin.scene.shape.files import MESH, TASK_SHAPE, remove_shape, write_shape
from twin.scene.shape.mesh import mesh_ply
from twin.scene.shape.reconstruct import ObjectShape
from twin.scene.store.ply import write_ply

OBJECT_VERSION = 3


@dataclass(frozen=True, kw_only=True)
class ObjectSplats:
    """One object's Gaussians in its own frame."""

    cloud: GaussianCloud
    T_base_object: Float[np.ndarray, "4 4"]
    """Where they were in the scene: the localised pose laid onto the Gaussians themselves."""


@dataclass(frozen=True, kw_only=True)
class SceneParts:
    """A scene taken apart."""

    background: GaussianCloud
    objects: dict[str, ObjectSplats]
    filling: GaussianCloud
    """Table under the objects that nobody saw; a guess, see ``fill``."""


def split_objects(
    cloud: GaussianCloud,
    localised: Mapping[str, LocalisedObject],
    task: Task,
    config: SplitConfig | None = None,
    shapes: Mapping[str, ObjectShape | str] | None = None,
) -> SceneParts:
    """Take the Gaussians of each localised object out of a scene.

    A Gaussian goes to the object whose surface is nearest, if it is near enough and nearer than the
    table; close to the table only if it has the object's colour. Every Gaussian ends up in exactly
    one part, but those of the table under an object, which nobody saw: the filling takes their
    place. Objects that were not found stay in the background.

    Args:
        cloud: The whole scene in ``base_link``.
        localised: Where the objects were while it was scanned.
        task: Their shapes and colours.
        config: Settings; the defaults when None.
        shapes: Reconstructed at ``object_poses``; without one the task's shape decides, which for
            a toy is the box around it.
    """
    config = SplitConfig() if config is None else config
    poses = object_poses(cloud, localised, task, config)
    known = {key: shape for key, shape in (shapes or {}).items() if isinstance(shape, ObjectShape)}
    owner = owners(cloud, poses, task, known, config)
    objects = {}
    for index, (key, T) in enumerate(poses.items()):
        part = moved_cloud(cloud.take(owner == index), se3.invert(T))
        objects[key] = ObjectSplats(cloud=part, T_base_object=T)
    hidden = hidden_table(cloud, owner, poses, known, task, config.min_likeness)
    background = cloud.take((owner < 0) & ~hidden)
    nothing = cloud.take(np.zeros(0, dtype=np.int64))
    filling = [fill_footprint(background, task.objects[key], T) for key, T in poses.items()]
    return SceneParts(
        background=background, objects=objects, filling=concatenate([nothing, *filling])
    )


def shape_mesh(
    model: ObjectModel,
) -> tuple[Float[np.ndarray, "num_vertices 3"], Int[np.ndarray, "num_faces 3"]]:
    """Triangles of the known shape in the object frame [m]: its mesh, or a box per panel."""
    if model.mesh is not None:
        known = object_mesh(model)
        return known.vertices_m, known.triangles
    vertices, faces = [], []
    corner = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    # Counter-clockwise seen from outside.
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    for index, (centre, extents) in enumerate(model.panels()):
        vertices.append(centre + corner * extents / 2)
        faces.append(triangles + 8 * index)
    return np.concatenate(vertices), np.concatenate(faces)


def write_objects(
    folder: Path,
    parts: SceneParts,
    localised: Mapping[str, LocalisedObject],
    task: Task,
    shapes: Mapping[str, ObjectShape | str] | None = None,
) -> dict[str, Any]:
    """Write ``objects/<id>/`` below a scene folder: Gaussians, mesh, ``object.json``.

    A reconstructed object also gets ``sdf.npz``, ``collision/*.ply`` and, when it is soft,
    ``soft.npz``, all in the object frame.

    Args:
        folder: The scene folder.
        parts: Their Gaussians.
        localised: Where they were found.
        task: Their known shapes.
        shapes: Reconstructed shapes in the object frame, or why there is none; the known shape
            is written for objects that are not listed, too.

    Returns:
        What ``scene.json`` says about the objects: files with their SHA-256, poses, counts.
    """
    record = {}
    for key, item in parts.objects.items():
        model, place = task.objects[key], folder / "objects" / key
        place.mkdir(parents=True, exist_ok=True)
        write_ply(place / "gaussians.ply", item.cloud)
        shape = "the views were not looked at" if shapes is None else shapes.get(key, "not seen")
        names, geometry = _write_geometry(place, model, shape)
        about = _object_record(model, item, localised[key]) | geometry
        about["files"] = {
            name: provenance.hash_file(place / name) for name in ("gaussians.ply", *names)
        }
        write_whole(place / "object.json", (json.dumps(about, indent=2) + "\n").encode())
        record[key] = {
            "folder": f"objects/{key}",
            "num_splats": len(item.cloud),
            "T_base_object": about["T_base_object"],
            "shape_source": about["shape_source"],
            "files": {
                **about["files"],
                "object.json": provenance.hash_file(place / "object.json"),
            },
        }
    return record


def _write_geometry(
    place: Path, model: ObjectModel, shape: ObjectShape | str
) -> tuple[list[str], dict[str, Any]]:
    """Write the reconstructed shape, or the known one with the reason why."""
    remove_shape(place)
    if not isinstance(shape, str):
        names, geometry = write_shape(place, shape, model.id, soft=model.soft is not None)
        source = shape.source or f"reconstructed from {shape.num_views} views"
        return names, {"shape_source": source, "geometry": geometry}
    write_whole(place / MESH, mesh_ply(*shape_mesh(model)))
    return [MESH], {"shape_source": TASK_SHAPE, "shape_remark": shape}


def _object_record(
    model: ObjectModel, item: ObjectSplats, localised: LocalisedObject
) -> dict[str, Any]:
    return {
        "schema_version": OBJECT_VERSION,
        "id": model.id,
        "shape": model.shape,
        "size_m": list(model.size_m),
        "wall_m": model.wall_m,
        "color_srgb": list(model.color_srgb),
        "symmetry": model.symmetry,
        "fixed": model.fixed,
        "frame": "all files of this folder are in the object frame",
        "num_splats": len(item.cloud),
        "T_base_object": _pose_record(item.T_base_object),
        "localisation": localised.to_record(),
    }


def _pose_record(T: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    q, p = se3.split(T)
    return {"p_m": p.tolist(), "q_wxyz": q.tolist()}
