"""The surfaces of a task's objects, and all that the planner knows of one start."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from bridge.episode.run_folder import RunFolder
from bridge.task.task_file import SCANNED, ObjectModel, Task
from twin.plan.problem import Covariance, Joints, Pose, Problem, Shape, Vector
from twin.replay.rebuilt_scene import MOST_OFF, read_rebuilt_scene
from twin.robot.model import load_robot
from twin.scene.shape.known import shape_mesh
from twin.scene.shape.mesh import UnreadableMeshError, read_mesh
from twin.scene.store.folder import read_record
from twin.scene.store.library import MESH, NOT_SCANNED, TASK_SHAPE, Library

GUESSED_SHARE = 0.1
"""Of its largest extent, a scanned object may be off that no scan has shown yet."""


def problem_of(
    run: RunFolder,
    task: Task,
    urdf: str,
    Ts_base_object: Mapping[str, Pose],
    covariances: Mapping[str, Covariance],
    start_rad: Joints | None,
) -> Problem:
    """Put together what the planner knows when it plans; no joints where nobody knows them."""
    return Problem(
        scene=replace(
            read_rebuilt_scene(run, task),
            urdf=urdf,
            Ts_base_object=dict(Ts_base_object),
            covariances=covariances,
            start_rad=start_rad,
        ),
        robot=load_robot(urdf),
        shapes=shapes_of(Library.of(run, read_record(run)), task),
    )


def shapes_of(library: Library | None, task: Task) -> dict[str, Shape]:
    """The surface of every object of a task, in its own frame; by the task where None scanned."""
    places = {key: None if library is None else library.place(key) for key in task.objects}
    return {key: _shape_of(places[key], model) for key, model in task.objects.items()}


def _shape_of(folder: Path | None, model: ObjectModel) -> Shape:
    if folder is None or not (folder / MESH).is_file():
        return _task_shape(model, f"task file: {NOT_SCANNED}")
    try:
        about = json.loads((folder / "object.json").read_text())
        source, geometry = str(about["shape_source"]), about.get("geometry") or {}
        truncation_m = float(geometry.get("truncation_m", 0.0))
        voxel_m = float(geometry.get("voxel_m", 0.0))
        closed = geometry.get("watertight") is True
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        return _task_shape(model, f"task file: what the scene says of it is damaged ({error!r})")
    if source == TASK_SHAPE:
        return _task_shape(model, "task file: the scene did not reconstruct it")
    if not closed:
        return _task_shape(model, "task file: the scene's mesh of it is not closed")
    try:
        vertices, triangles = read_mesh(folder / MESH)
    except UnreadableMeshError as error:
        return _task_shape(model, f"task file: {error}")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    known_low, known_high = _extents(model)
    off = float(np.max(np.abs((high - low) / (known_high - known_low) - 1.0)))
    source_text = f"scan ({source})"
    if model.shape != SCANNED:
        if off > MOST_OFF:
            return _task_shape(model, f"task file: an extent of the scene's mesh is {off:.0%} off")
        shift = (known_low + known_high - low - high) / 2
        shift[2] = known_low[2] - low[2]  # it stands on the table
        vertices = vertices + shift
        source_text += f", moved by {np.linalg.norm(shift) * 1e3:.1f} mm onto the task's shape"
    return Shape(
        vertices_m=vertices,
        triangles=triangles,
        source=source_text,
        trusted_from_m=float(vertices[:, 2].min()) + truncation_m,
        error_m=voxel_m,
    )


def _extents(model: ObjectModel) -> tuple[Vector, Vector]:
    """Lowest and highest corner of an object in its frame."""
    half = np.array(model.size_m) / 2
    middle = np.array([0.0, 0.0, 0.0 if model.origin_at_centre else half[2]])
    return middle - half, middle + half


def _task_shape(model: ObjectModel, why: str) -> Shape:
    vertices, triangles = shape_mesh(model)
    if model.shape != SCANNED:
        return Shape(vertices_m=vertices, triangles=triangles, source=why)
    return Shape(
        vertices_m=vertices,
        triangles=triangles,
        source=f"{why}; only the box around it is known",
        error_m=GUESSED_SHARE * max(model.size_m),
    )
