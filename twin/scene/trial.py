"""An episode in the rebuilt scene: which objects it shows, from what each is drawn, and where.

Objects stand where the trial's localisation has them. One that no scan saw is drawn from the task's
shape, coloured by frames from before the first motion: what is compared later must not teach it.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.task_file import Task
from twin.robot.model import load_robot
from twin.robot.posture import PostureTrack, posture_track
from twin.scene.align.moved_camera import MovedCamera, MovedCameraError
from twin.scene.fit.lighting import Lighting
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view
from twin.scene.localise.episode import (
    MOVED,
    first_execution_ns,
    moved_cameras,
    trial_cameras,
    write_localised,
)
from twin.scene.localise.stationary_frames import Poses, stationary_frames
from twin.scene.movable_scene import MovableScene, read_movable_scene
from twin.scene.object_tracks import ObjectTracks, localised_tracks
from twin.scene.objects.closing import closed_object
from twin.scene.objects.decompose import ObjectSplats
from twin.scene.settings import FrameConfig
from twin.scene.shape.known import shape_mesh
from twin.scene.shape.mesh import Mesh, read_mesh
from twin.scene.store.folder import Scene
from twin.scene.store.library import MESH, NOT_SCANNED, Library, objects_folder, task_of

FIRST_FRAMES = 8
"""Of each camera before the first motion, for the colours of what was not scanned."""


@dataclass(frozen=True, kw_only=True)
class TrialInScene:
    """What an episode says of robot and objects while its scene is drawn."""

    recorded: Episode
    parts: MovableScene
    """With the objects of this episode alone."""
    tracks: ObjectTracks
    postures: PostureTrack | None
    robot: str
    """How the robot stands, or why it is not drawn."""
    notes: tuple[str, ...]
    """What nobody saw, and what was not scanned."""
    moved: Mapping[str, MovedCamera] = field(default_factory=dict)
    """Cameras that are elsewhere than their poses say, by id."""

    def places(self, stamp_ns: int) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Where its objects are at an instant, ``T_base_object``; some in the hand."""
        T_base_tcp = None
        if self.postures is not None and self.postures.covers(stamp_ns):
            joints_rad = self.postures.at(stamp_ns).joints_rad
            T_base_tcp = load_robot(self.postures.urdf).T_base_tcp(joints_rad)
        return self.tracks.at(stamp_ns, T_base_tcp)

    def registered(
        self, camera_id: str, T_base_camera: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "4 4"]:
        """Where a camera is that its poses put there.

        Raises:
            MovedCameraError: When it was moved, and nobody knows where to.
        """
        moved = self.moved.get(camera_id)
        if moved is None:
            return T_base_camera
        if moved.T_posed_true is None:
            found = moved.describe(camera_id)
            message = f"{self.recorded.info.id} is not rendered from there: {found}."
            raise MovedCameraError(message)
        return np.asarray(T_base_camera @ moved.T_posed_true)

    def meshes(self, run: RunFolder) -> dict[str, Mesh]:
        """Surfaces of the objects that are drawn, each in its own frame."""
        folder, task = objects_folder(run), task_of(self.recorded)
        return {
            name: shape_mesh(task.objects[name])
            if name in self.parts.not_scanned and task is not None
            else read_mesh(folder / name / MESH)
            for name in self.parts.objects
        }


def open_trial(run: RunFolder, scene: Scene, recorded: Episode) -> TrialInScene:
    """Gather all that moves in an episode.

    A recorded trial is localised before and after its executions if it was not yet.
    """
    postures, robot = None, f"joints as {recorded.path.stem} has them"
    try:
        postures = posture_track(recorded)
    except GstError as error:
        robot = f"not drawn: {error}"
    if not scene.record.get("robot", {}).get("links"):
        remark = scene.record.get("robot", {}).get("remark")
        reason = f" ({remark})" if remark else ""
        robot = f"not drawn: the scene has no robot splats{reason}"
    tracks, moved = _recorded_tracks(run, scene, recorded, postures)
    task = task_of(recorded)
    parts, notes = trial_parts(run, scene, recorded, task, tracks.first(), moved)
    soft = [] if task is None else [name for name in task.soft_objects if name in parts.objects]
    notes += [f"{', '.join(soft)}: drawn unbent; replay --render bends"] if soft else []
    return TrialInScene(
        recorded=recorded,
        parts=parts,
        tracks=tracks,
        postures=postures,
        robot=robot,
        notes=(*(item.describe(key) for key, item in moved.items()), *tracks.notes, *notes),
        moved=moved,
    )


def _recorded_tracks(
    run: RunFolder, scene: Scene, episode: Episode, postures: PostureTrack | None
) -> tuple[ObjectTracks, dict[str, MovedCamera]]:
    """Where a recorded episode's objects were, localised and carried, and which cameras moved."""
    try:
        task = streams.task_file(episode).task()
        path = write_localised(run, episode, task, scene_hash=scene.scene_hash)
        localised = Episode.open(path)
        records, about = streams.localisations(localised), localised.derived
    except GstError as error:
        tracks = ObjectTracks(notes=(f"objects are drawn where they were scanned: {error}",))
        with suppress(GstError):  # without a camera that could say it
            return tracks, moved_cameras(run, episode)
        return tracks, {}
    found = {} if about is None else about.settings.get(MOVED, {})
    moved = {key: MovedCamera.from_record(value) for key, value in found.items()}
    return localised_tracks(episode, records, task, postures), moved


def trial_parts(
    run: RunFolder,
    scene: Scene,
    episode: Episode,
    task: Task | None,
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]] | None,
    moved: Mapping[str, MovedCamera] = MappingProxyType({}),
) -> tuple[MovableScene, list[str]]:
    """What is drawn of a scene in one episode, and what has to be said of it.

    Args:
        Ts_base_object: Where its objects were before the first motion; those without a pose are
            not drawn. None: nobody localised them, and they stand where they were scanned.
    """
    library = Library.of(run, scene.record)
    scanned, missing = library.scanned(task), library.not_scanned(task)
    if task is None or Ts_base_object is None:
        return read_movable_scene(run, scene, scanned), library.notes(task)
    parts = read_movable_scene(run, scene, [name for name in scanned if name in Ts_base_object])
    others = {name: Ts_base_object[name] for name in missing if name in Ts_base_object}
    made = {}
    if others:
        poses = trial_cameras(run, episode, moved)
        made = _from_task(episode, task, others, poses, parts.lighting)
    notes = [
        note if name in made else f"{name} was {NOT_SCANNED} and is not drawn: nobody saw it"
        for name, note in zip(missing, library.notes(task), strict=True)
    ]
    objects = {**parts.objects, **made}
    return replace(parts, objects=objects, not_scanned=frozenset(made)), notes


def _from_task(
    episode: Episode,
    task: Task,
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
    poses: Poses,
    lighting: Lighting,
) -> dict[str, ObjectSplats]:
    """Objects in the task's shape and in the colours that they had before the first motion."""
    limits = DepthLimits(max_depth_m=FrameConfig().max_depth_m)
    before_ns = first_execution_ns(episode)
    frames = stationary_frames(episode, FIRST_FRAMES, before_ns=before_ns, poses=poses)
    views = [training_view(FrameSurface(frame, limits)) for frame in frames]
    made = {}
    for name, T in Ts_base_object.items():
        cloud = closed_object(shape_mesh(task.objects[name]), views, T, lighting)
        if cloud is not None:
            made[name] = ObjectSplats(cloud=cloud, T_base_object=T)
    return made
