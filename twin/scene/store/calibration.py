"""``scene/calibration.json``: cameras and physics, as ``robot-gst calibrate`` found out.

Written by ``twin.calibrate``, read by whoever poses frames or replays. Only cameras that were
identified are listed under ``cameras``; what was not stands under ``not_identified`` with the
reason. ``physics`` holds every parameter, and under ``identified`` what replays use.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import provenance, streams
from bridge.episode.cdr.messages import FrameTransform
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.transforms import TransformTree
from bridge.errors import InvalidRecordError
from bridge.geometry import se3
from bridge.robots.robot import robot_of
from bridge.whole_file import write_whole
from twin.errors import UnreadableFileError
from twin.robot.model import load_robot
from twin.robot.posture import PostureTrack, posture_track

CALIBRATION_FILE = "calibration.json"
CALIBRATION_VERSION = 1
_OLD_BASE = "base_link"
"""Link of fixed cameras in files that do not say how a camera is mounted."""
UNNAMED = ("calibration_id", "software", "physics_history")  # the last in older files
"""What does not change what a calibration does, and so not its name."""


class UnreadableCalibrationError(UnreadableFileError):
    """``calibration.json`` is damaged or from a newer version."""

    hint = "Remove it, or make it again: robot-gst calibrate RUN --cameras."


@dataclass(frozen=True, kw_only=True)
class MountedCamera:
    """Where one camera is mounted."""

    link: str
    """Link that carries it; the robot's base for a fixed camera."""
    stream: str
    """``color`` or ``depth``: whose optical frame is meant."""
    T_link_camera: Float[np.ndarray, "4 4"]
    depth_scale: float = 1.0
    """True depth divided by measured depth, where that was identified."""
    fixed: bool = False
    """Whether the camera stands still."""

    def to_record(self) -> dict[str, Any]:
        """Plain numbers: all that poses made with it depend on."""
        return {
            "link": self.link,
            "stream": self.stream,
            "T_link_camera": self.T_link_camera.tolist(),
            "depth_scale": self.depth_scale,
        }


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """The content of ``calibration.json``."""

    record: Mapping[str, Any]
    cameras: Mapping[str, MountedCamera]

    @property
    def calibration_id(self) -> str:
        """Eight hexadecimal digits that name it in verdicts and replays."""
        return str(self.record["calibration_id"])


def read_calibration(run: RunFolder) -> Calibration | None:
    """Read ``scene/calibration.json``, or return None when there is none."""
    path = run.scene_dir / CALIBRATION_FILE
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text())
        version = record["schema_version"]
        if version != CALIBRATION_VERSION:
            found = f"schema version {version!r}, this program knows {CALIBRATION_VERSION}"
            raise UnreadableCalibrationError(path=path, found=found)
        cameras = {key: _mount(value) for key, value in record["cameras"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, InvalidRecordError) as error:
        raise UnreadableCalibrationError(path=path, found=f"no calibration ({error})") from error
    return Calibration(record=record, cameras=cameras)


def _mount(record: Mapping[str, Any]) -> MountedCamera:
    return MountedCamera(
        link=str(record["link"]),
        stream=str(record["stream"]),
        T_link_camera=se3.pose_from_record(record["T_link_camera"]),
        depth_scale=float(record.get("depth_scale", 1.0)),
        fixed=record.get("mount", "fixed" if record["link"] == _OLD_BASE else "hand") == "fixed",
    )


def write_calibration(
    run: RunFolder, cameras: Mapping[str, Any], not_identified: Mapping[str, str]
) -> dict[str, Any]:
    """Write ``calibration.json``; cameras identified earlier and not looked at now are kept."""
    kept = _kept(run)
    known = {**kept.get("cameras", {}), **cameras}
    lost = {**kept.get("not_identified", {}), **not_identified}
    return _store(
        run,
        {
            **kept,
            "cameras": {key: known[key] for key in sorted(known)},
            "not_identified": {key: lost[key] for key in sorted(lost) if key not in known},
        },
    )


def write_physics(run: RunFolder, physics: Mapping[str, Any]) -> dict[str, Any]:
    """Write what was found out about physics; what was not promoted replaces nothing."""
    kept = _kept(run)
    is_used = physics["promoted"] or kept.get("physics") is None
    return _store(run, {**kept, "physics": dict(physics)} if is_used else kept)


def write_part(run: RunFolder, name: str, part: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Write what was learned, in place of an earlier one; returns it and the calibration's id."""
    named = {**part, "id": provenance.hash_settings(dict(part))}
    return named, str(_store(run, {**_kept(run), name: named})["calibration_id"])


def _kept(run: RunFolder) -> dict[str, Any]:
    before = read_calibration(run)
    return {"cameras": {}, "not_identified": {}, **({} if before is None else before.record)}


def _store(run: RunFolder, content: Mapping[str, Any]) -> dict[str, Any]:
    """Name the content and put it in place."""
    record = {**content, "schema_version": CALIBRATION_VERSION, "software": provenance.software()}
    named = {key: value for key, value in record.items() if key not in UNNAMED}
    record["calibration_id"] = provenance.hash_settings(named)
    run.scene_dir.mkdir(parents=True, exist_ok=True)
    path = run.scene_dir / CALIBRATION_FILE
    write_whole(path, (json.dumps(record, indent=2) + "\n").encode())
    return record


def calibrated_tree(
    episode: Episode,
    camera_id: str,
    mount: MountedCamera,
    stamps_ns: Int[np.ndarray, " num_frames"],
) -> TransformTree:
    """Pose a camera's colour and depth frames in the robot's base at some instants.

    A camera in the hand follows the recorded joints. How colour and depth lie to each other comes
    from the recording's own transforms; without them they count as aligned.
    """
    color = streams.camera_info(episode, camera_id).frame_id
    has_depth = streams.find_camera_topic(episode, camera_id, "depth/info") is not None
    depth = streams.camera_info(episode, camera_id, "depth").frame_id if has_depth else color
    track = None if mount.fixed else posture_track(episode)
    return mounted_tree(mount, (color, depth), streams.transform_tree(episode), stamps_ns, track)


def mounted_tree(
    mount: MountedCamera,
    frames: tuple[str, str],
    tree: TransformTree,
    stamps_ns: Int[np.ndarray, " num_frames"],
    track: PostureTrack | None,
) -> TransformTree:
    """Pose a camera in the robot's base as it is mounted, recorded or live.

    Args:
        tree: Knows how they lie to each other, or does not: then they count as aligned.
        track: Where the hand was; a fixed camera needs none.
    """
    color, depth = frames
    T_color_depth = np.eye(4)
    known = color != depth and {color, depth} <= set(tree.frames())
    if known and tree.root_of(color) == tree.root_of(depth):
        at = int(stamps_ns[0]) if len(stamps_ns) else 0
        T_color_depth = se3.invert(tree.T_root_frame(color, at)) @ tree.T_root_frame(depth, at)
    T_camera_color = np.eye(4) if mount.stream == "color" else se3.invert(T_color_depth)
    base = mount.link if track is None else robot_of(track.urdf).base_frame
    edges = []
    for stamp, T_base_link in zip(stamps_ns, _links(mount, stamps_ns, track), strict=True):
        T_base_color = T_base_link @ mount.T_link_camera @ T_camera_color
        edges.append(edge(base, color, T_base_color, int(stamp)))
        if color != depth:
            edges.append(edge(base, depth, T_base_color @ T_color_depth, int(stamp)))
    return TransformTree(edges)


def _links(
    mount: MountedCamera, stamps_ns: Int[np.ndarray, " num_frames"], track: PostureTrack | None
) -> list[np.ndarray]:
    if track is None:
        return [np.eye(4)] * len(stamps_ns)
    robot = load_robot(track.urdf)
    return [robot.T_base_link(mount.link, track.at(int(stamp)).joints_rad) for stamp in stamps_ns]


def without_joints(
    episode: Episode, mount: MountedCamera, stamps_ns: Int[np.ndarray, " num_frames"]
) -> frozenset[int]:
    """Those of some instants at which nobody recorded where the hand that carries a camera was."""
    return unknown_postures(None if mount.fixed else posture_track(episode), stamps_ns)


def unknown_postures(
    track: PostureTrack | None, stamps_ns: Int[np.ndarray, " num_frames"]
) -> frozenset[int]:
    """Those of some instants around which a track has no joints, or values that are not finite.

    Args:
        track: Where the robot was; None: it does not matter, and the answer is empty.
    """
    if track is None:
        return frozenset()
    return frozenset(
        stamp
        for stamp in stamps_ns.tolist()
        if not track.covers(stamp) or not np.isfinite(track.at(stamp).joints_rad).all()
    )


def edge(parent: str, child: str, T: np.ndarray, stamp_ns: int) -> FrameTransform:
    """A transform at an instant."""
    return FrameTransform(stamp_ns=stamp_ns, parent=parent, child=child, T_parent_child=T)
