"""Which objects the episodes of a scene show, where, and which pixels and points are theirs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import binary_dilation

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.task.find import MissingTaskError, union_of
from bridge.task.task_file import Task, TaskFile
from bridge.terminal import Output
from twin.scene.frames.rgbd import PointSet, TrainingView
from twin.scene.frames.selection import FrameChoice, Sources
from twin.scene.localise.episode import localise_episode
from twin.scene.localise.result import LocalisedObject
from twin.scene.shape.known import shape_mesh, surface_distances
from twin.scene.shape.mesh import first_hit

OWN_M, LIFTED_M = 0.010, 0.003
"""Points this near to an object's known surface, and so far above the table, are the object's."""
UNDER_M = 0.004
"""Table this near to an object is hidden by it."""
IN_FRONT_M = 0.03
"""A measurement this much nearer than an object shows something in front of it."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Where one episode has the objects of its task, while nothing moved them."""

    episode: Episode
    task: Task
    localised: Mapping[str, LocalisedObject]

    @property
    def poses(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """``T_base_object`` of those that were found."""
        found = {key: item.T_base_object for key, item in self.localised.items()}
        return {key: T for key, T in found.items() if T is not None}

    def owns(self, p_m: Float32[np.ndarray, "num_points 3"]) -> Bool[np.ndarray, " num_points"]:
        """Which points (base frame) show an object."""
        return np.asarray((p_m[:, 2] > LIFTED_M) & self._near(p_m, OWN_M))

    def covers(self, p_m: Float32[np.ndarray, "num_points 3"]) -> Bool[np.ndarray, " num_points"]:
        """Which points of the table an object stands on, or nearly so."""
        on_top = np.column_stack([p_m[:, :2], np.maximum(p_m[:, 2], 0.0)])
        return np.asarray((p_m[:, 2] <= LIFTED_M) & self._near(on_top, UNDER_M))

    def _near(self, p_m: np.ndarray, margin_m: float) -> Bool[np.ndarray, " num_points"]:
        mine = np.zeros(len(p_m), dtype=bool)
        for key, T in self.poses.items():
            model = self.task.objects[key]
            reach_m = np.float32(np.linalg.norm(model.size_m) + margin_m)
            ids = np.flatnonzero(np.abs(p_m - T[:3, 3].astype(np.float32)).max(axis=1) < reach_m)
            distance_m, _ = surface_distances(p_m[ids].astype(np.float64), model, T)
            mine[ids[distance_m < margin_m]] = True
        return mine

    def shown_in(self, view: TrainingView) -> Bool[np.ndarray, "half_height half_width"]:
        """Pixels of the half-size image that show an object, and those next to them."""
        half, poses = view.half, self.poses
        meshes = {key: shape_mesh(self.task.objects[key]) for key in poses}
        expected, _ = first_hit(half.camera.rays(), view.T_base_color, meshes, poses)
        known = half.depth_m > 0
        shown = np.isfinite(expected) & ~(known & (half.depth_m < expected - IN_FRONT_M))
        p_camera = half.camera.unproject(half.depth_m)[known]
        shown[known] |= self.owns(se3.apply(view.T_base_color, p_camera).astype(np.float32))
        return np.asarray(binary_dilation(shown, np.ones((3, 3), dtype=bool)))


@dataclass(frozen=True, kw_only=True)
class ScannedTasks:
    """The task files of a scene's episodes, each with the episodes that show its objects."""

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
    """Find the task files whose objects are looked for: of every scan, else one episode a task."""
    files: list[tuple[Episode, TaskFile]] = []
    missing: dict[str, None] = {}
    for episode in sources.episodes:
        if not episode.info.task:
            continue
        try:
            file = streams.task_file(episode)
        except MissingTaskError as error:
            missing[str(error)] = None
            continue
        known = {each.sha256 for _, each in files}
        if episode.info.kind == "scan" or file.sha256 not in known:
            files.append((episode, file))
    return ScannedTasks(files=tuple(files), missing=tuple(missing))


@dataclass(frozen=True, kw_only=True)
class Placements:
    """The objects of a scene's episodes."""

    task: Task | None = None
    """With the objects of all; None: nothing is known of objects."""
    by_episode: Mapping[Path, Placement]
    remark: str
    """Why objects are not taken out, or which are missing; empty when there is nothing to say."""

    def take_out(
        self, episode: Episode, points: PointSet, view: TrainingView
    ) -> tuple[PointSet, TrainingView]:
        """A frame's points without the objects', and its view with the objects masked."""
        placement = self.by_episode.get(episode.path)
        if placement is None or not placement.poses:
            return points, view
        return points.take(~placement.owns(points.p_m)), view.without(placement.shown_in(view))


NO_OBJECTS = Placements(by_episode={}, remark="")


def find_placements(sources: Sources, choices: Sequence[FrameChoice], output: Output) -> Placements:
    """Look for the objects of every scan's task, in the frames that are not held out.

    Raises:
        UsageError: When two task files define one object differently, or one is no task.
    """
    tasks = scanned_tasks(sources)
    task = tasks.task
    if task is None:
        remark = "; ".join(tasks.missing) or "no episode names a task"
        return Placements(by_episode={}, remark=f"objects not known: {remark}")
    if any(choice.poses.source == "odometry" for choice in choices):
        remark = (
            "objects not taken out: nothing says where the table is in a scene whose camera was "
            "followed by its images"
        )
        return Placements(by_episode={}, remark=remark)
    placed: dict[Path, Placement] = {}
    try:
        for episode, file in tasks.files:
            own_task = file.task()
            names = ", ".join(own_task.objects)
            output.say(f"look for {names} in {episode.info.id} and take them out")
            own = [choice for choice in choices if choice.episode.path == episode.path]
            localised = localise_episode(
                episode,
                own_task,
                held_out_ns={choice.camera_id: choice.holdout_ns for choice in own},
                poses={c.camera_id: c.poses for c in own if c.poses.source == "hand-eye"},
            )
            placed[episode.path] = Placement(episode=episode, task=own_task, localised=localised)
    except GstError as error:
        return Placements(by_episode={}, remark=f"objects not taken out: {error}")
    found = {key for item in placed.values() for key in item.poses}
    reasons = {
        key: f"{key} not found: {each.reason}"
        for item in placed.values()
        for key, each in item.localised.items()
        if key not in found
    }
    remark = "; ".join([*tasks.missing, *reasons.values()])
    return Placements(task=task, by_episode=placed, remark=remark)
