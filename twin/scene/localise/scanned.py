"""Shapes that only a scan knows: the reconstructed meshes of a scene, to localise with."""

import json
from dataclasses import dataclass, field

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder
from bridge.task.task_file import SCANNED, Task
from twin.scene.localise.surface import Surface, surface_of
from twin.scene.shape.files import MESH, TASK_SHAPE
from twin.scene.shape.mesh import read_mesh
from twin.scene.store.folder import UnreadableSceneError


@dataclass(frozen=True, kw_only=True)
class ScannedSurfaces:
    """What the scene adds to a task's shapes."""

    surfaces: dict[str, Surface] = field(default_factory=dict)
    """By object, in its own frame."""
    hashes: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the mesh each was read from."""


def scanned_surfaces(run: RunFolder, task: Task, num_samples: int) -> ScannedSurfaces:
    """Read the meshes of a task's scanned objects, as far as the scene has reconstructed them.

    Args:
        run: Whose scene is read.
        task: Other objects have a shape of their own there.
        num_samples: Points spread over each mesh.

    Raises:
        UnreadableSceneError: When ``object.json`` cannot be understood.
        UnreadableMeshError: When a mesh is damaged.
    """
    found = ScannedSurfaces()
    for key, model in task.objects.items():
        folder = run.scene_dir / "objects" / key
        about = folder / "object.json"
        if model.shape != SCANNED or not about.is_file():
            continue
        try:
            source = json.loads(about.read_text())["shape_source"]
        except (ValueError, KeyError, TypeError) as error:
            found_ = f"does not say where its shape comes from ({error!r})"
            raise UnreadableSceneError(path=about, found=found_) from error
        if source == TASK_SHAPE:
            continue
        found.surfaces[key] = surface_of(*read_mesh(folder / MESH), num_samples)
        found.hashes[key] = provenance.hash_file(folder / MESH)
    return found
