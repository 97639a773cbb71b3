"""Localise the objects of a recorded episode, and keep the answer as a derived episode."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import provenance, schema, streams
from bridge.episode.executions import EXECUTION, NO_PLAN, executed_events
from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import LOCALISATION, cell_topic
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError, GstError
from bridge.geometry import se3
from bridge.task.task_file import Task
from twin.scene.align.moved_camera import MovedCamera, moved_camera
from twin.scene.frames.camera_poses import CameraPoses, base_tree, poses_shifted
from twin.scene.frames.selection import rgbd_camera_ids
from twin.scene.localise.held import executions_ns, held_objects
from twin.scene.localise.mesh_fit import MeshSurface, ScannedSurfaces, scanned_surfaces
from twin.scene.localise.objects import MAX_FRAMES, MAX_VIEWS, localise_objects
from twin.scene.localise.result import LocalisedObject
from twin.scene.localise.stationary_frames import (
    HeldOut,
    Poses,
    calibrated_cameras,
    stationary_frames,
)
from twin.scene.store.calibration import Calibration, read_calibration
from twin.scene.store.folder import read_record, read_scene

NO_SCENE = "noscene"
MOVED = "moved"
"""In the settings of a localisation: cameras that were found to have moved since the scan."""
STILL_FRAMES = 3
"""Of each camera, for that."""
LOCALISE_VERSION = 6
"""Counts changes of method that make older localisations out of date."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A stretch of an episode in which nothing was executed."""

    name: str
    """start, or end of an execution."""
    plan_id: str | None
    after_ns: int | None
    before_ns: int | None


def localise_episode(
    episode: Episode,
    task: Task,
    *,
    after_ns: int | None = None,
    before_ns: int | None = None,
    held_out_ns: HeldOut | None = None,
    last_seen_m: Mapping[str, Float[np.ndarray, "3"]] | None = None,
    surfaces: Mapping[str, MeshSurface] | None = None,
    poses: Poses | None = None,
) -> dict[str, LocalisedObject]:
    """Localise from the last still frames before the first execution started.

    Without an execution, as in a scan, still frames spread over the whole episode are used.
    Stand-in truth is never read.

    Args:
        after_ns: Only frames later than this source time; then ``before_ns`` counts alone.
        last_seen_m: Where objects were seen before; tells equal ones apart.
    """
    if after_ns is None and before_ns is None:
        before_ns = first_execution_ns(episode)
    evenly = after_ns is None and before_ns is None
    frames = stationary_frames(
        episode,
        MAX_VIEWS if evenly else MAX_FRAMES,
        after_ns,
        before_ns,
        evenly=evenly,
        held_out_ns=held_out_ns,
        poses=poses,
    )
    return localise_objects(frames, task, last_seen_m, surfaces)


MOTION_MARGIN_NS = 80_000_000
"""Frames so near to a motion that only the joints tell of are not still for sure: clocks of cameras
and robots differ, and the first millimetres are in the noise."""


def first_execution_ns(episode: Episode) -> int | None:
    """Source time at which the first execution started, None without one."""
    return quiet_phases(episode)[0].before_ns


def quiet_phases(episode: Episode) -> list[Phase]:
    """The start of the episode, and what follows each execution until the next one."""
    marks = sorted(
        (
            (int(event["stamp_ns"]) + _margin_ns(event), str(event["type"]), event.get("plan_id"))
            for event in executed_events(episode)
            if event["type"] in EXECUTION
        ),
        key=lambda mark: mark[0],
    )
    first = next((stamp for stamp, kind, _ in marks if kind == "execution_started"), None)
    phases = [Phase(name="start", plan_id=None, after_ns=None, before_ns=first)]
    for stamp, kind, plan_id in marks:
        if kind == "execution_ended":
            following = (s for s, k, _ in marks if k == "execution_started" and s > stamp)
            phases.append(
                Phase(name="end", plan_id=plan_id, after_ns=stamp, before_ns=next(following, None))
            )
    return phases


def _margin_ns(event: Mapping[str, Any]) -> int:
    if event.get("plan_id") != NO_PLAN:
        return 0
    return -MOTION_MARGIN_NS if event["type"] == EXECUTION[0] else MOTION_MARGIN_NS


def write_localised(
    run: RunFolder, episode: Episode, task: Task, *, scene_hash: str | None = None
) -> Path:
    """Write ``derived/<episode>.localised.<scene>.mcap`` and return its path.

    Holds one gst localisation record per object for the start and after every execution. Objects
    whose shape only a scan knows are laid out by the meshes of the run's scene, and calibrated
    cameras are where the run's calibration says. A file made from the same bytes with the same
    settings is kept.

    Args:
        scene_hash: The scene the poses are meant for; its first twelve digits name the file.
    """
    calibration = read_calibration(run)
    scanned = scanned_surfaces(run, task)
    scene = scene_hash[:12] if scene_hash else NO_SCENE
    path = run.derived_dir / f"{episode.path.stem}.localised.{scene}.mcap"
    derived = Derived(
        kind="localised",
        source_episode=episode.info.id,
        source_sha256=episode.sha256(),
        scene_hash=scene_hash,
        engine="colour_shape_fit",
        settings={"task": asdict(task), "method": LOCALISE_VERSION}
        | ({"meshes": scanned.hashes} if scanned.hashes else {})
        | _mounts(calibration, rgbd_camera_ids(episode)),
    )
    if path.exists() and _made_from(path, derived):
        return path
    moved = moved_cameras(run, episode)
    if moved:
        about = {key: item.to_record() for key, item in moved.items()}
        derived = replace(derived, settings={**derived.settings, MOVED: about})
    poses = trial_cameras(run, episode, moved)
    records = [*_localised_phases(episode, task, scanned, poses)]
    topic = cell_topic(episode.info.cell or "cell", LOCALISATION)
    path.unlink(missing_ok=True)
    with EpisodeWriter(path) as writer:
        writer.describe(episode.info, derived=derived)
        for stamp_ns, record in records:
            writer.write(topic, record, type_name=schema.LOCALISATION, log_time_ns=stamp_ns)
    return path


def moved_cameras(run: RunFolder, episode: Episode) -> dict[str, MovedCamera]:
    """Cameras of an episode that were moved since the scan, by its still frames before any motion.

    None where there is no scene, or where it is in another frame than these cameras.
    """
    record = read_record(run)
    if record is None or record.get("frame") != streams.recorded_robot(episode).base_frame:
        return {}
    poses, before_ns = trial_cameras(run, episode, {}), first_execution_ns(episode)
    frames = stationary_frames(episode, STILL_FRAMES, before_ns=before_ns, poses=poses)
    try:
        background, found = read_scene(run).background, {}
    except GstError:  # nothing to compare with: who draws the scene says why
        return {}
    for camera_id in {frame.camera_id for frame in frames}:
        own = [frame for frame in frames if frame.camera_id == camera_id]
        moved = moved_camera(own, background)
        if moved is not None:
            found[camera_id] = moved
    return found


def trial_cameras(run: RunFolder, episode: Episode, moved: Mapping[str, MovedCamera]) -> Poses:
    """Where cameras of an episode are, as far as something else than ``/tf`` says it."""
    poses = dict(calibrated_cameras(episode, read_calibration(run)))
    for camera_id, item in moved.items():
        known = poses.get(camera_id) or CameraPoses(tree=base_tree(episode), source="tf")
        poses[camera_id] = poses_shifted(known, episode, camera_id, item.T_posed_true)
    return poses


def _localised_phases(
    episode: Episode, task: Task, scanned: ScannedSurfaces, poses: Poses
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Localise in one quiet stretch after the other; each tells the next where objects were.

    Of each object a record, and its stamp [ns]; ``in_hand`` in it is what cameras saw in the
    execution before: ``grip_ns``, when the fingers stood closed, and ``T_tcp_object``. What was
    held is expected where it was let go.
    """
    spans_ns = executions_ns(episode)
    last_seen_m: dict[str, np.ndarray] = {}
    for phase in quiet_phases(episode):
        in_hand: dict[str, list[dict[str, Any]]] = {}
        span_ns = spans_ns.get(phase.plan_id or "", (0, 0))
        held = held_objects(episode, span_ns, task, scanned.surfaces, poses, last_seen_m)
        for name, grip, T in [*held]:
            entry = {"grip_ns": grip.start_ns, "T_tcp_object": se3.pose_record(T)}
            in_hand.setdefault(name, []).append(entry)
            let_go_m = (grip.T_base_tcp_end @ T)[:3, 3]
            last_seen_m[name] = np.append(let_go_m[:2], last_seen_m.get(name, let_go_m)[2])
        found = localise_episode(
            episode,
            task,
            after_ns=phase.after_ns,
            before_ns=phase.before_ns,
            last_seen_m=last_seen_m,
            surfaces=scanned.surfaces,
            poses=poses,
        )
        for key, item in found.items():
            record = {**item.to_record(), "phase": phase.name, "plan_id": phase.plan_id}
            record |= {"in_hand": in_hand[key]} if key in in_hand else {}
            yield item.stamp_ns or phase.after_ns or phase.before_ns or 0, record
            if item.T_base_object is not None:
                last_seen_m[key] = item.T_base_object[:3, 3]


def _mounts(calibration: Calibration | None, camera_ids: Collection[str]) -> dict[str, Any]:
    """What a localisation depends on beside the episode; nothing without calibrated cameras."""
    places = {} if calibration is None else calibration.cameras
    mounts = {key: places[key].to_record() for key in camera_ids if key in places}
    return {"cameras": mounts} if mounts else {}


def _made_from(path: Path, derived: Derived) -> bool:
    try:
        found = Episode.open(path).derived
    except EpisodeError:
        return False
    return (
        found is not None
        and (found.source_sha256, found.scene_hash) == (derived.source_sha256, derived.scene_hash)
        and provenance.hash_settings({k: v for k, v in found.settings.items() if k != MOVED})
        == provenance.hash_settings(derived.settings)
    )
