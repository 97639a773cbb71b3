"""An episode in the rebuilt scene: which objects it shows, from what each is drawn, and where.

Objects stand where the trial's localisation has them. One that no scan saw is drawn from the task's
shape, coloured by frames from before the first motion: what is compared later must not teach it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.task_file import Task
from twin.robot.model import load_robot
from twin.robot.posture import PostureTrack, posture_track
from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view
from twin.scene.localise.episode import first_execution_ns, write_localised
from twin.scene.localise.stationary_frames import calibrated_cameras, stationary_frames
from twin.scene.movable_scene import MovableScene, read_movable_scene
from twin.scene.object_tracks import ObjectTracks, localised_tracks
from twin.scene.objects.closing import closed_object
from twin.scene.objects.decompose import ObjectSplats
from twin.scene.settings import FrameConfig, InitialiseConfig
from twin.scene.shape.files import MESH
from twin.scene.shape.known import shape_mesh
from twin.scene.shape.mesh import Mesh, read_mesh
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import Scene
from twin.scene.store.library import NOT_SCANNED, Library, objects_folder, task_of

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
    unposed: list[int] = field(default_factory=list)
    """Instants left out because nobody knows where the camera was."""

    def places(self, stamp_ns: int) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Where its objects are at an instant, ``T_base_object``; some in the hand."""
        T_base_tcp = None
        if self.postures is not None and self.postures.covers(stamp_ns):
            joints_rad = self.postures.at(stamp_ns).joints_rad
            T_base_tcp = load_robot(self.postures.urdf).T_base_tcp(joints_rad)
        return self.tracks.at(stamp_ns, T_base_tcp)

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
    tracks = _recorded_tracks(run, scene, recorded, postures)
    parts, notes = trial_parts(run, scene, recorded, task_of(recorded), tracks.first())
    return TrialInScene(
        recorded=recorded,
        parts=parts,
        tracks=tracks,
        postures=postures,
        robot=robot,
        notes=(*tracks.notes, *notes),
    )


def _recorded_tracks(
    run: RunFolder, scene: Scene, episode: Episode, postures: PostureTrack | None
) -> ObjectTracks:
    """Where a recorded episode's objects were: localised, and carried in between."""
    try:
        task = streams.task_file(episode).task()
        path = write_localised(run, episode, task, scene_hash=scene.scene_hash)
        records = streams.localisations(Episode.open(path))
    except GstError as error:
        return ObjectTracks(notes=(f"objects are drawn where they were scanned: {error}",))
    return localised_tracks(episode, records, task, postures)


def trial_parts(
    run: RunFolder,
    scene: Scene,
    episode: Episode,
    task: Task | None,
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]] | None,
) -> tuple[MovableScene, list[str]]:
    """What is drawn of a scene in one episode, and what has to be said of it.

    Args:
        task: The episode's; None: all that was scanned is drawn.
        Ts_base_object: Where its objects were before the first motion; those without a pose are
            not drawn. None: nobody localised them, and they stand where they were scanned.
    """
    library = Library.of(run, scene.record)
    scanned, missing = library.scanned(task), library.not_scanned(task)
    if task is None or Ts_base_object is None:
        return read_movable_scene(run, scene, scanned), library.notes(task)
    parts = read_movable_scene(run, scene, [name for name in scanned if name in Ts_base_object])
    others = {name: Ts_base_object[name] for name in missing if name in Ts_base_object}
    made = _from_task(run, episode, task, others) if others else {}
    notes = [
        note if name in made else f"{name} was {NOT_SCANNED} and is not drawn: nobody saw it"
        for name, note in zip(missing, library.notes(task), strict=True)
    ]
    objects = {**parts.objects, **made}
    return replace(parts, objects=objects, not_scanned=frozenset(made)), notes


def _from_task(
    run: RunFolder,
    episode: Episode,
    task: Task,
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
) -> dict[str, ObjectSplats]:
    """Objects in the task's shape and in the colours that they had before the first motion."""
    config = InitialiseConfig()
    limits = DepthLimits(
        max_depth_m=FrameConfig().max_depth_m, flying_fraction=config.flying_fraction
    )
    frames = stationary_frames(
        episode,
        FIRST_FRAMES,
        before_ns=first_execution_ns(episode),
        poses=calibrated_cameras(episode, read_calibration(run)),
    )
    views = [training_view(FrameSurface(frame, limits)) for frame in frames]
    made = {}
    for name, T in Ts_base_object.items():
        cloud = closed_object(shape_mesh(task.objects[name]), views, T, config)
        if cloud is not None:
            made[name] = ObjectSplats(cloud=cloud, T_base_object=T)
    return made
