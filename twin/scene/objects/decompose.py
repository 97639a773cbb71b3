"""Decompose a fitted scene into background and objects, and compose it again.

The background plus objects in their own frames: an object can be put anywhere. The mesh is
reconstructed from the views where they allow it; otherwise it is the known shape of the task file,
and ``shape_source`` says so. Gaussians are cut along the reconstructed shape (``assign_splats``)
out of the background, and the object's own are set anew on its mesh, all around it. Table
under the objects that nobody saw is filled with the distance-weighted mean of the table around: a
guess that keeps renders free of black holes, counted separately in ``scene.json``.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from bridge.episode import provenance, streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.errors import GstError, InvalidRecordError
from bridge.geometry import se3
from bridge.task.find import MissingTaskError, union_of
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import ObjectModel, Task, TaskFile
from bridge.terminal import Output
from bridge.whole_file import write_whole
from twin.scene.frames.rgbd import TrainingView
from twin.scene.frames.selection import FrameChoice, Sources
from twin.scene.gaussians import (
    GaussianCloud,
    as_float32,
    concatenate,
    moved_cloud,
    read_ply,
    write_ply,
)
from twin.scene.localise.episode import localise_episode
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects.assignment import (
    HALO_M,
    SplitConfig,
    assign_splats,
    hidden_table,
    object_poses,
)
from twin.scene.objects.closing import closed_object
from twin.scene.settings import InitialiseConfig
from twin.scene.shape.files import MESH, SDF, TASK_SHAPE, remove_shape, write_shape
from twin.scene.shape.from_training import Poses, shapes_of, write_static
from twin.scene.shape.mesh import mesh_ply
from twin.scene.shape.reconstruct import ObjectShape
from twin.scene.shape.sdf import SdfGrid
from twin.scene.store.folder import UnreadableSceneError

SPACING_M = 0.004
GROWN_M = HALO_M + 0.003
"""How far beyond the footprint holes are looked for: what is dropped reaches to the halo."""
TABLE_M = 0.008
"""Gaussians this near z = 0 are table."""
NEIGHBOURS = 12
OPACITY_LOGIT = 3.0


def fill_footprint(
    background: GaussianCloud, model: ObjectModel, T_base_object: Float[np.ndarray, "4 4"]
) -> GaussianCloud:
    """Flat Gaussians on the table wherever the background leaves a hole under an object.

    Returns:
        The filling alone, marked as completed; empty where the table was seen, or where there is
        none around.
    """
    half = np.array(model.size_m[:2]) / 2 + GROWN_M
    steps = [np.arange(-h, h + SPACING_M / 2, SPACING_M) for h in half]
    local = np.stack([*np.meshgrid(*steps), np.zeros((len(steps[1]), len(steps[0])))], axis=-1)
    xy = se3.apply(T_base_object, local.reshape(-1, 3))[:, :2]
    means = background.means_m.astype(np.float64)
    reach = float(np.linalg.norm(half)) + 0.03
    near = np.linalg.norm(means[:, :2] - T_base_object[:2, 3], axis=1) < reach
    table = np.flatnonzero(near & (np.abs(means[:, 2]) < TABLE_M))
    if len(table) < NEIGHBOURS:
        return background.take(np.zeros(0, dtype=np.int64))
    distance, ids = cKDTree(means[table, :2]).query(xy, k=NEIGHBOURS)
    holes = distance[:, 0] > SPACING_M
    weight = 1.0 / distance[holes] ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    around = table[ids[holes]]
    count = int(holes.sum())
    scales = np.log([0.75 * SPACING_M, 0.75 * SPACING_M, 0.1 * SPACING_M])
    z = (weight * means[around, 2]).sum(axis=1)
    colors = (weight[..., None] * background.colors[around]).sum(axis=1)
    return GaussianCloud(
        means_m=as_float32(np.column_stack([xy[holes], z])),
        quats_wxyz=as_float32(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))),
        scales_log=as_float32(np.tile(scales, (count, 1))),
        opacities_logit=as_float32(np.full(count, OPACITY_LOGIT)),
        colors=as_float32(colors),
    ).as_completed()


OBJECT_VERSION = 4


@dataclass(frozen=True, kw_only=True)
class ObjectSplats:
    """One object's Gaussians in its own frame."""

    cloud: GaussianCloud
    T_base_object: Float[np.ndarray, "4 4"]
    """Where it was scanned: as localised, like in every trial; of objects without a reconstructed
    shape that pose laid onto the Gaussians themselves."""
    sdf: SdfGrid | None = None
    """Distances to its reconstructed surface; None where there is none."""


@dataclass(frozen=True, kw_only=True)
class SceneParts:
    """A scene divided into background and objects."""

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
        shapes: Reconstructed, in the frames of the objects; without one the task's shape decides,
            which for a toy is the box around it.
    """
    config = SplitConfig() if config is None else config
    poses = object_poses(cloud, localised, task, config)
    known = {key: shape for key, shape in (shapes or {}).items() if isinstance(shape, ObjectShape)}
    owner = assign_splats(cloud, poses, task, known, config)
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


def closed_parts(
    parts: SceneParts,
    poses: Poses,
    shapes: Mapping[str, ObjectShape | str],
    views: Sequence[TrainingView],
    config: InitialiseConfig,
) -> SceneParts:
    """Set the Gaussians of objects with a reconstructed shape anew, on all of its surface.

    Args:
        parts: As cut out of the scene; objects without such a shape stay as they are.
        shapes: In the frames of the objects.
        config: The shape of new Gaussians.
    """
    objects = dict(parts.objects)
    for key in parts.objects:
        shape = shapes.get(key)
        if isinstance(shape, ObjectShape):
            mesh = (shape.vertices_m, shape.faces)
            closed = closed_object(mesh, views, poses[key], config)
            if closed is not None:
                objects[key] = ObjectSplats(cloud=closed, T_base_object=poses[key])
    return replace(parts, objects=objects)


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

    A reconstructed object also gets ``sdf.npz`` and, when it is soft, ``soft.npz``, both in the
    object frame.

    Args:
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
            "num_completed": about["num_completed"],
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
        names, geometry = write_shape(place, shape, soft=model.soft is not None)
        source = f"reconstructed from {shape.num_views} views"
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
        "num_completed": int(item.cloud.completed.sum()),
        "T_base_object": se3.pose_record(item.T_base_object),
        "localisation": localised.to_record(),
    }


@dataclass(frozen=True, kw_only=True)
class Decomposition:
    """A scene in parts, or whole with the reason why."""

    background: GaussianCloud
    """What ``background.ply`` holds: the table under the objects is filled in."""
    remark: str
    parts: SceneParts | None = None
    localised: Mapping[str, LocalisedObject] | None = None
    task: Task | None = None
    shapes: Mapping[str, ObjectShape | str] | None = None
    """Reconstructed from the views, in the frame of each object, or why not."""

    def write(self, run: RunFolder, views: Sequence[TrainingView] = ()) -> dict[str, Any]:
        """Write ``objects/`` and ``sdf.npz``, and return what ``scene.json`` says about them."""
        static = write_static(run.scene_dir, views, self.task, self.places)
        if self.parts is None or self.localised is None or self.task is None:
            return {"objects": {}, "objects_remark": self.remark, "sdf": static}
        objects = write_objects(run.scene_dir, self.parts, self.localised, self.task, self.shapes)
        return {
            "objects": objects,
            "objects_remark": self.remark,
            "filled_splats": len(self.parts.filling),
            "sdf": static,
        }

    def surfaces_m(self) -> dict[str, Float[np.ndarray, "_ 3"]]:
        """Vertices of the reconstructed objects where they were scanned."""
        return {
            key: se3.apply(T, shape.vertices_m)
            for key, T in self.places.items()
            if isinstance(shape := (self.shapes or {}).get(key), ObjectShape)
        }

    @property
    def places(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Poses of the objects that were taken out."""
        objects = {} if self.parts is None else self.parts.objects
        return {key: item.T_base_object for key, item in objects.items()}


@dataclass(frozen=True, kw_only=True)
class ScannedTasks:
    """The task files of a scene's episodes, each with the first episode recorded with it."""

    files: Sequence[tuple[Episode, TaskFile]]
    missing: Sequence[str]
    """Why there is none for an episode that names a task."""

    @property
    def task(self) -> Task | None:
        """The objects of all of them.

        Raises:
            UsageError: When two files define one object differently, or one is no task.
        """
        return union_of(file for _, file in self.files)


def scanned_tasks(sources: Sources) -> ScannedTasks:
    """Find the task files whose objects are looked for."""
    files: dict[str, tuple[Episode, TaskFile]] = {}
    missing: dict[str, None] = {}
    for episode in sources.episodes:
        if not episode.info.task:
            continue
        try:
            file = streams.task_file(episode)
        except MissingTaskError as error:
            missing[str(error)] = None
        else:
            files.setdefault(file.sha256, (episode, file))
    return ScannedTasks(files=tuple(files.values()), missing=tuple(missing))


def decompose(
    sources: Sources,
    cloud: GaussianCloud,
    choices: Sequence[FrameChoice],
    views: Sequence[TrainingView] = (),
    output: Output | None = None,
    initialise: InitialiseConfig | None = None,
) -> Decomposition:
    """Cut the tasks' objects out of the scene where the first episode of each task shows them.

    Args:
        choices: Which frames are held out: the objects are not looked for in them.
        views: What the scene was fitted to; objects are reconstructed from them.
        output: How to talk; None: say nothing.
        initialise: The shape of new Gaussians; the defaults when None.

    Raises:
        UsageError: When two task files define one object differently, or one is no task.
    """
    output = Output(quiet=True) if output is None else output
    tasks = scanned_tasks(sources)
    task = tasks.task
    if task is None:
        remark = "; ".join(tasks.missing) or "no episode names a task"
        return Decomposition(background=cloud, remark=f"objects not known: {remark}")
    if any(choice.poses.source == "odometry" for choice in choices):
        remark = (
            "objects not taken out: nothing says where the table is in a scene whose camera was "
        )
        return Decomposition(background=cloud, remark=f"{remark}followed by its images")
    localised: dict[str, LocalisedObject] = {}
    try:
        for episode, file in tasks.files:
            for key, item in _localised(episode, file.task(), choices, output).items():
                if key not in localised or not localised[key].found:  # where it was seen first
                    localised[key] = item
    except GstError as error:
        return Decomposition(background=cloud, remark=f"objects not taken out: {error}")
    poses = {
        key: item.T_base_object for key, item in localised.items() if item.T_base_object is not None
    }
    with output.progress("reconstruct objects", len(poses)) as advance:
        shapes = shapes_of(views, task.objects, poses, advance=advance)
    parts = split_objects(cloud, localised, task, shapes=shapes)
    parts = closed_parts(parts, poses, shapes, views, initialise or InitialiseConfig())
    missing = {key: item.reason for key, item in localised.items() if not item.found}
    remarks = [f"{key} not found: {reason}" for key, reason in missing.items()]
    remark = "; ".join([*tasks.missing, *remarks])
    return Decomposition(
        background=concatenate([parts.background, parts.filling]),
        remark=remark,
        parts=parts,
        localised=localised,
        task=task,
        shapes=shapes,
    )


def _localised(
    episode: Episode, task: Task, choices: Sequence[FrameChoice], output: Output
) -> dict[str, LocalisedObject]:
    """Look for a task's objects in the frames of one episode that are not held out."""
    output.say(f"look for {', '.join(task.objects)} in {episode.info.id} and take them out")
    own = [choice for choice in choices if choice.episode.path == episode.path]
    return localise_episode(
        episode,
        task,
        held_out_ns={choice.camera_id: choice.holdout_ns for choice in own},
        poses={c.camera_id: c.poses for c in own if c.poses.source == "hand-eye"},
    )


def read_objects(run: RunFolder, record: Mapping[str, Any]) -> dict[str, ObjectSplats]:
    """Load the objects that ``scene.json`` lists, each in its own frame."""
    objects = {}
    for key in record.get("objects", {}):
        folder = run.scene_dir / "objects" / check_episode_id(key)
        has_sdf = SDF in record["objects"][key].get("files", {})
        objects[key] = ObjectSplats(
            cloud=read_ply(folder / "gaussians.ply"),
            T_base_object=_read_pose(folder / "object.json"),
            sdf=SdfGrid.load(folder / SDF) if has_sdf else None,
        )
    return objects


def _read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    try:
        pose = json.loads(path.read_text())["T_base_object"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UnreadableSceneError(path=path, found=f"no pose ({error!r})") from error
    return read_pose(pose, path)


def read_pose(pose: Any, path: Path) -> Float[np.ndarray, "4 4"]:
    """Turn ``p_m`` and ``q_wxyz`` of a scene's JSON file into a transform."""
    try:
        return se3.pose_from_record(pose)
    except InvalidRecordError as error:
        raise UnreadableSceneError(path=path, found=f"a pose that is none: {pose}") from error
