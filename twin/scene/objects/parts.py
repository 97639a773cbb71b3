"""Take a fitted scene apart into background and objects, and put it together again."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.task.task_file import ObjectModel, Task, load_task
from bridge.terminal import Output
from twin.scene.foundation.complete import Completed, Shapes
from twin.scene.frames.choice import FrameChoice, Sources
from twin.scene.frames.training_view import TrainingView
from twin.scene.gaussians.cloud import GaussianCloud, concatenate
from twin.scene.gaussians.moved import moved_cloud
from twin.scene.localise.episode import localise_episode
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects.owners import object_poses
from twin.scene.objects.remains import Poses
from twin.scene.objects.split import ObjectSplats, SceneParts, split_objects, write_objects
from twin.scene.shape.from_training import shapes_of, write_static
from twin.scene.shape.reconstruct import ObjectShape
from twin.scene.store.folder import UnreadableSceneError
from twin.scene.store.ply import read_ply

Complete = Callable[[Sequence[TrainingView], Mapping[str, ObjectModel], Poses, Shapes], Completed]


@dataclass(frozen=True, kw_only=True)
class TakenApart:
    """A scene in parts, or whole with the reason why."""

    background: GaussianCloud
    """What ``background.ply`` holds: the table under the objects is filled in."""
    remark: str
    parts: SceneParts | None = None
    localised: Mapping[str, LocalisedObject] | None = None
    task: Task | None = None
    shapes: Mapping[str, ObjectShape | str] | None = None
    """Reconstructed from the views, in the frame of each object, or why not."""
    generated: Mapping[str, Any] = field(default_factory=dict)
    """What came of asking a shape generator, by object."""

    def write(self, run: RunFolder, views: Sequence[TrainingView] = ()) -> dict[str, Any]:
        """Write ``objects/`` and ``sdf.npz``, and return what ``scene.json`` says about them.

        Args:
            run: Whose scene folder is written.
            views: What the scene was fitted to; says what is static.
        """
        static = write_static(run.scene_dir, views, self.task, self.places)
        if self.parts is None or self.localised is None or self.task is None:
            return {"objects": {}, "objects_remark": self.remark, "sdf": static}
        objects = write_objects(run.scene_dir, self.parts, self.localised, self.task, self.shapes)
        return {
            "objects": objects,
            "objects_remark": self.remark,
            "filled_splats": len(self.parts.filling),
            "sdf": static,
            **({"generated": dict(self.generated)} if self.generated else {}),
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


def episode_of_task(sources: Sources) -> Episode | None:
    """The episode whose task and whose objects count: the first that names a task."""
    return next((episode for episode in sources.episodes if episode.info.task), None)


def take_apart(
    sources: Sources,
    cloud: GaussianCloud,
    choices: Sequence[FrameChoice],
    views: Sequence[TrainingView] = (),
    complete: Complete | None = None,
    output: Output | None = None,
) -> TakenApart:
    """Cut the task's objects out of the scene where the first episode of a task shows them.

    Args:
        sources: The episodes the scene was made from.
        cloud: The whole fitted scene.
        choices: Which frames are held out: the objects are not looked for in them.
        views: What the scene was fitted to; objects are reconstructed from them.
        complete: Asks a shape generator about them; None: nobody is asked.
        output: How to talk; None: say nothing.
    """
    output = Output(quiet=True) if output is None else output
    episode = episode_of_task(sources)
    if episode is None:
        return TakenApart(background=cloud, remark="no episode names a task: objects not known")
    if any(choice.poses.source == "odometry" for choice in choices):
        remark = (
            "objects not taken out: nothing says where the table is in a scene whose camera was "
        )
        return TakenApart(background=cloud, remark=f"{remark}followed by its images")
    try:
        task = load_task(episode.info.task)
        output.say(f"look for {', '.join(task.objects)} in {episode.info.id} and take them out")
        held_out = {
            choice.camera_id: choice.holdout_ns
            for choice in choices
            if choice.episode.path == episode.path
        }
        mounted = {
            choice.camera_id: choice.poses
            for choice in choices
            if choice.episode.path == episode.path and choice.poses.source == "hand-eye"
        }
        localised = localise_episode(episode, task, held_out_ns=held_out, poses=mounted)
    except GstError as error:
        return TakenApart(background=cloud, remark=f"objects not taken out: {error}")
    poses = object_poses(cloud, localised, task)
    with output.progress("reconstruct objects", len(poses)) as advance:
        shapes = shapes_of(views, task.objects, poses, advance=advance)
    asked = Completed(shapes=shapes, record={})
    if complete is not None:
        asked = complete(views, task.objects, poses, shapes)
    parts = split_objects(cloud, localised, task, shapes=asked.shapes)
    missing = {key: item.reason for key, item in localised.items() if not item.found}
    remark = "; ".join(f"{key} not found: {reason}" for key, reason in missing.items())
    return TakenApart(
        background=concatenate([parts.background, parts.filling]),
        remark=remark,
        parts=parts,
        localised=localised,
        task=task,
        shapes=asked.shapes,
        generated=asked.record,
    )


def read_objects(run: RunFolder, record: Mapping[str, Any]) -> dict[str, ObjectSplats]:
    """Load the objects that ``scene.json`` lists, each in its own frame.

    Raises:
        PathNotFoundError: When a splat file is gone.
        UnreadablePlyError: When one is damaged.
        UnreadableSceneError: When ``scene.json`` or ``object.json`` cannot be understood.
    """
    objects = {}
    for key in record.get("objects", {}):
        folder = run.scene_dir / "objects" / check_episode_id(key)
        objects[key] = ObjectSplats(
            cloud=read_ply(folder / "gaussians.ply"),
            T_base_object=_read_pose(folder / "object.json"),
        )
    return objects


def _read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    try:
        pose = json.loads(path.read_text())["T_base_object"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UnreadableSceneError(path=path, found=f"no pose ({error!r})") from error
    return read_pose(pose, path)


def read_pose(pose: Any, path: Path) -> Float[np.ndarray, "4 4"]:
    """Turn ``p_m`` and ``q_wxyz`` of a scene's JSON file into a transform.

    Raises:
        UnreadableSceneError: When they are no pose; names the file.
    """
    try:
        q, p = np.array(pose["q_wxyz"], dtype=np.float64), np.array(pose["p_m"], dtype=np.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise UnreadableSceneError(path=path, found=f"no pose ({error!r})") from error
    if q.shape != (4,) or p.shape != (3,) or not np.isfinite([*q, *p]).all() or not q.any():
        raise UnreadableSceneError(path=path, found=f"a pose that is none: {pose}")
    return se3.transform_from(q, p)


def put_together(
    background: GaussianCloud,
    objects: Mapping[str, ObjectSplats],
    Ts_base_object: Mapping[str, np.ndarray] | None = None,
) -> GaussianCloud:
    """Place every object in the background: where it was scanned, or where the mapping says."""
    places = {} if Ts_base_object is None else Ts_base_object
    placed = [
        moved_cloud(item.cloud, places.get(key, item.T_base_object))
        for key, item in objects.items()
    ]
    return concatenate([background, *placed])
