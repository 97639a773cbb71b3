"""Localise the objects of a recorded episode, and keep the answer as a derived episode."""

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bridge.episode import provenance, schema, streams
from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode
from bridge.episode.records import PoseSample
from bridge.episode.run import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.episode.transforms import TransformTree
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError
from bridge.task.robot import BASE_FRAME
from bridge.task.task_file import Task
from twin.scene.frames.choice import rgbd_camera_ids
from twin.scene.frames.still import same_pose
from twin.scene.localise.objects import LocaliseConfig, localise_objects
from twin.scene.localise.result import LocalisedObject
from twin.scene.localise.scanned import scanned_surfaces
from twin.scene.localise.surface import Surface

NO_SCENE = "noscene"
STILL_WINDOW_NS = 40_000_000
"""A camera is still when its pose is the same this long before and after an image."""
STILL_DISTANCE_M = 1e-3
STILL_ANGLE_RAD = 3e-3

HeldOut = Mapping[str, Collection[int]]
"""Stamps of frames to leave out, by camera id."""


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
    config: LocaliseConfig | None = None,
    *,
    after_ns: int | None = None,
    before_ns: int | None = None,
    held_out_ns: HeldOut | None = None,
    last_seen_m: Mapping[str, Float[np.ndarray, "3"]] | None = None,
    surfaces: Mapping[str, Surface] | None = None,
) -> dict[str, LocalisedObject]:
    """Localise from the last still frames before the first execution started.

    Without an execution, as in a scan, still frames spread over the whole episode are used.
    Stand-in truth is never read.

    Args:
        episode: Recorded, with posed colour and depth.
        task: Whose objects are looked for.
        config: Settings; the defaults when None.
        after_ns: Only frames later than this source time; then ``before_ns`` counts alone.
        before_ns: Only frames earlier than this source time.
        held_out_ns: Frames that must not be looked at.
        last_seen_m: Where objects were seen before; tells equal ones apart.
        surfaces: Of scanned objects, from the scene.
    """
    config = LocaliseConfig() if config is None else config
    if after_ns is None and before_ns is None:
        before_ns = first_execution_ns(episode)
    if after_ns is None and before_ns is None:
        frames = still_frames(episode, config.max_views, spread=True, held_out_ns=held_out_ns)
    else:
        frames = still_frames(
            episode, config.max_frames, after_ns, before_ns, held_out_ns=held_out_ns
        )
    return localise_objects(frames, task, config, last_seen_m, surfaces)


def first_execution_ns(episode: Episode) -> int | None:
    """Source time of the first ``execution_started`` event, None without one."""
    stamps = [
        int(event["stamp_ns"])
        for event in streams.events(episode)
        if event["type"] == "execution_started"
    ]
    return min(stamps, default=None)


def quiet_phases(episode: Episode) -> list[Phase]:
    """The start of the episode, and what follows each execution until the next one."""
    marks = sorted(
        (
            (int(event["stamp_ns"]), str(event["type"]), event.get("plan_id"))
            for event in streams.events(episode)
            if event["type"] in ("execution_started", "execution_ended")
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


def still_frames(
    episode: Episode,
    max_per_camera: int,
    after_ns: int | None = None,
    before_ns: int | None = None,
    *,
    spread: bool = False,
    held_out_ns: HeldOut | None = None,
) -> list[RgbdFrame]:
    """Frames of each camera taken in an interval while that camera did not move.

    Args:
        episode: Recorded, with posed colour and depth.
        max_per_camera: At most so many.
        after_ns: Only frames later than this source time.
        before_ns: Only frames earlier than this source time.
        spread: Spread them evenly over the interval instead of taking the last ones.
        held_out_ns: Frames that must not be looked at.
    """
    hidden = held_out_ns or {}
    tree = streams.transform_tree(episode)
    frames: list[RgbdFrame] = []
    for camera_id in rgbd_camera_ids(episode):
        frame_id = streams.camera_info(episode, camera_id, "color").frame_id
        kept: deque[RgbdFrame] = deque(maxlen=None if spread else max_per_camera)
        for frame in _between(streams.rgbd_frames(episode, camera_id, tree), after_ns, before_ns):
            seen = frame.stamp_ns not in hidden.get(camera_id, ())
            if seen and is_still(tree, frame_id, frame.stamp_ns, before_ns):
                kept.append(frame)
        if spread and len(kept) > max_per_camera:
            ids = np.linspace(0, len(kept) - 1, max_per_camera).round().astype(int)
            frames.extend(kept[index] for index in ids)
        else:
            frames.extend(kept)
    return frames


def _between(
    frames: Iterable[RgbdFrame], after_ns: int | None, before_ns: int | None
) -> Iterator[RgbdFrame]:
    for frame in frames:
        if before_ns is not None and frame.stamp_ns >= before_ns:
            return
        if after_ns is None or frame.stamp_ns > after_ns:
            yield frame


def is_still(
    tree: TransformTree, frame_id: str, stamp_ns: int, until_ns: int | None = None
) -> bool:
    """Say whether a frame's pose is the same shortly before and after an instant."""
    last_ns = (
        stamp_ns + STILL_WINDOW_NS
        if until_ns is None
        else min(stamp_ns + STILL_WINDOW_NS, until_ns)
    )
    before = tree.T_root_frame(frame_id, stamp_ns - STILL_WINDOW_NS)
    after = tree.T_root_frame(frame_id, last_ns)
    return same_pose(before, after, distance_m=STILL_DISTANCE_M, angle_rad=STILL_ANGLE_RAD)


def write_localised(
    run: RunFolder,
    episode: Episode,
    task: Task,
    config: LocaliseConfig | None = None,
    *,
    scene_hash: str | None = None,
    force: bool = False,
) -> Path:
    """Write ``derived/<episode>.localised.<scene>.mcap`` and return its path.

    Holds one gst localisation record per object for the start and after every execution, and a
    PoseStamped per object that was found. Objects whose shape only a scan knows are laid out by the
    meshes of the run's scene. A file made from the same bytes with the same settings
    is kept unless ``force``.

    Args:
        run: Where derived episodes go.
        episode: The recorded source.
        task: Whose objects are looked for.
        config: Settings; the defaults when None.
        scene_hash: The scene the poses are meant for; its first twelve digits name the file.
        force: Write again even when it is there.
    """
    config = LocaliseConfig() if config is None else config
    scanned = scanned_surfaces(run, task, config.mesh.num_samples)
    scene = scene_hash[:12] if scene_hash else NO_SCENE
    path = run.derived_dir / f"{episode.path.stem}.localised.{scene}.mcap"
    derived = Derived(
        kind="localised",
        source_episode=episode.info.id,
        source_sha256=episode.sha256(),
        scene_hash=scene_hash,
        engine="colour_shape_fit",
        settings={"task": asdict(task), **asdict(config)}
        | ({"meshes": scanned.hashes} if scanned.hashes else {}),
    )
    if path.exists() and not force and _made_from(path, derived):
        return path
    phases: list[tuple[Phase, dict[str, LocalisedObject]]] = []
    last_seen_m: dict[str, np.ndarray] = {}
    for phase in quiet_phases(episode):
        found = localise_episode(
            episode,
            task,
            config,
            after_ns=phase.after_ns,
            before_ns=phase.before_ns,
            last_seen_m=last_seen_m,
            surfaces=scanned.surfaces,
        )
        phases.append((phase, found))
        last_seen_m |= {
            key: item.T_base_object[:3, 3]
            for key, item in found.items()
            if item.T_base_object is not None
        }
    path.unlink(missing_ok=True)
    with EpisodeWriter(path) as writer:
        writer.describe(episode.info, derived=derived)
        for phase, objects in phases:
            _write_phase(writer, _cell_of(episode), phase, objects)
    return path


def _made_from(path: Path, derived: Derived) -> bool:
    try:
        found = Episode.open(path).derived
    except EpisodeError:
        return False
    return (
        found is not None
        and (found.source_sha256, found.scene_hash)
        == (
            derived.source_sha256,
            derived.scene_hash,
        )
        and provenance.hash_settings(found.settings) == provenance.hash_settings(derived.settings)
    )


def _cell_of(episode: Episode) -> str:
    if episode.info.cell:
        return episode.info.cell
    for topic in episode.topics_of_type(schema.COMPRESSED_IMAGE):
        return topic.split("/")[1]
    return "cell"


def _write_phase(
    writer: EpisodeWriter, cell: str, phase: Phase, objects: dict[str, LocalisedObject]
) -> None:
    for object_id, found in objects.items():
        stamp_ns = found.stamp_ns or phase.after_ns or phase.before_ns or 0
        record = {**found.to_record(), "phase": phase.name, "plan_id": phase.plan_id}
        writer.write_json(
            f"/{cell}/localisation",
            record,
            type_name=schema.LOCALISATION,
            log_time_ns=stamp_ns,
            publish_time_ns=stamp_ns,
        )
        if found.T_base_object is not None:
            sample = PoseSample(
                stamp_ns=stamp_ns, frame_id=BASE_FRAME, T_frame_body=found.T_base_object
            )
            writer.write(
                f"/{cell}/object/{object_id}/pose",
                sample.to_cdr(),
                type_name=schema.POSE_STAMPED,
                log_time_ns=stamp_ns,
                publish_time_ns=stamp_ns,
            )
