"""``robot-gst calibrate RUN --cameras``: each camera from what was recorded of it.

From pose pairs of a target where there are some; otherwise from the robot in its depth images when
it stands still, and when it moves from its images of scans.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import CAMERAS, DEPTH_IMAGE, DEPTH_INFO, TARGET_POSE, is_truth
from bridge.errors import BridgeError, GstError, UsageError
from bridge.geometry import se3
from bridge.robots.robot import robot_of
from bridge.terminal import Output
from twin.calibrate.carried import find_carried_camera
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.hand_eye import PosePairs, find_camera
from twin.robot.model import load_robot
from twin.robot.posture import Posture, PostureTrack, distinct_postures, posture_track
from twin.scene.align.align import RobotNotAlignedError, align_robot
from twin.scene.align.view import RobotView
from twin.scene.frames.camera_poses import base_tree, never_moves
from twin.scene.store.calibration import CALIBRATION_FILE, write_calibration

MAX_POSTURES = 6
"""A fixed camera is found from the robot in this many different postures, those farthest apart."""


def placement(episodes: Sequence[Episode]) -> dict[str, bool]:
    """Cameras with depth images and intrinsics, and whether they move in any episode.

    A camera that no transform mentions counts as fixed: it can still be found from the robot.
    """
    found: dict[str, bool] = {}
    for episode in episodes:
        for camera_id in depth_cameras(episode):
            frame = streams.camera_info(episode, camera_id, "depth").frame_id
            tree = streams.transform_tree(episode)
            known = frame in tree.frames()
            posed_ns = tree.stamps_ns(frame) if known else np.zeros(0, dtype=np.int64)
            moves = len(posed_ns) > 0 and not never_moves(tree, frame, posed_ns)
            found[camera_id] = found.get(camera_id, False) or moves
    return found


def depth_cameras(episode: Episode) -> list[str]:
    """Cameras of an episode with depth images and their intrinsics, never those of truth."""
    topics = {topic for topic in episode.topics() if not is_truth(topic)}
    stems = [topic.removesuffix(DEPTH_IMAGE) for topic in topics if topic.endswith(DEPTH_IMAGE)]
    return sorted(
        stem.split("/")[-1] for stem in stems if f"{stem}{DEPTH_INFO}" in topics and CAMERAS in stem
    )


@dataclass(frozen=True)
class _Seen:
    """A depth image that shows the robot standing still."""

    episode: Episode
    stamp_ns: int
    posture: Posture
    urdf: str


def find_fixed_camera(episodes: Sequence[Episode], camera_id: str, base: str) -> dict[str, Any]:
    """Find the pose and depth scale of a fixed depth camera in the robot's base frame.

    The search begins where the recording has the camera; when the robot is not there, or the
    recording does not say, the whole table is searched.
    """
    seen, reasons = list[_Seen](), list[GstError]()
    for episode in episodes:
        try:
            track = posture_track(episode)
        except GstError as error:
            reasons.append(error)
            continue
        stamps = [image.stamp_ns for image in streams.depth_images(episode, camera_id)]
        at_rest = filter(track.is_stationary, stamps)
        seen += [_Seen(episode, ns, track.at(ns), track.urdf) for ns in at_rest]
    if reasons and len(reasons) == len(episodes):
        raise reasons[0]
    if not seen:
        raise RobotNotAlignedError(
            found=f"camera {camera_id} has no depth image with the robot standing still",
            hint="Stop the robot for half a second at each of several postures while recording.",
        )
    joints = np.array([item.posture.joints_rad for item in seen])
    chosen = [seen[index] for index in distinct_postures(joints, MAX_POSTURES)]
    views = [view for episode in episodes for view in _load(episode, camera_id, chosen)]
    robot = load_robot(chosen[0].urdf)
    nominal = _nominal_pose(chosen[0], camera_id)
    try:
        alignment = align_robot(views, robot, start=nominal)
    except RobotNotAlignedError:
        if nominal is None:
            raise
        alignment = align_robot(views, robot)
    record = {
        "method": "depth of the robot against its description",
        "mount": "fixed",
        "link": base,
        "stream": "depth",
        "T_link_camera": se3.pose_record(alignment.T_base_source),
        **alignment.to_record(),
        "sources": list(dict.fromkeys(item.episode.info.id for item in chosen)),
    }
    if nominal is not None:
        change = se3.invert(nominal) @ alignment.T_base_source
        record["correction_m"] = float(np.linalg.norm(change[:3, 3]))
        record["correction_rad"] = float(se3.rotation_angle_rad(change[:3, :3]))
    return record


def _load(episode: Episode, camera_id: str, chosen: Sequence[_Seen]) -> Iterator[RobotView]:
    wanted = {i.stamp_ns: i.posture for i in chosen if i.episode.path == episode.path}
    if not wanted:
        return
    camera = streams.camera_info(episode, camera_id, "depth").camera
    for image in streams.depth_images(episode, camera_id):
        if image.stamp_ns in wanted:
            yield RobotView(
                camera=camera,
                depth_m=image.depth_m(),
                T_source_camera=np.eye(4),
                posture=wanted[image.stamp_ns],
            )


def _nominal_pose(seen: _Seen, camera_id: str) -> Float[np.ndarray, "4 4"] | None:
    """The pose of the depth camera in the robot's base as the recording has it, if it has one."""
    tree = base_tree(seen.episode)
    frame = streams.camera_info(seen.episode, camera_id, "depth").frame_id
    try:
        T = tree.T_root_frame(frame, seen.stamp_ns)
        root = tree.root_of(frame)
    except BridgeError:
        return None
    return T if root == streams.recorded_robot(seen.episode).base_frame else None


# Pose pairs: an episode holds the target's pose in the camera on ``/<cell>/cam/<id>/target/pose``;
# the robot's side comes from its joints at the same instant.

SAME_PLACE_RAD = 0.004
"""Detections at joints nearer than this belong to one stop of the robot and are averaged."""


def target_cameras(episodes: Sequence[Episode]) -> list[str]:
    """Cameras with recorded target poses; stand-in truth is never among them."""
    return sorted(
        {
            topic.split("/")[-3]
            for episode in episodes
            for topic in episode.topics_of_type(schema.POSE_STAMPED)
            if topic.endswith(TARGET_POSE) and CAMERAS in topic
        }
    )


def recorded_pairs(episodes: Sequence[Episode], camera_id: str, link: str) -> PosePairs:
    """Pair recorded target poses of one camera with the robot's link, robot standing still.

    Poses that are no numbers, as some detectors send when they see nothing, are left out.

    Args:
        episodes: Those without poses of a target from this camera are passed over.
        link: Robot link whose pose in the base is the other half of a pair.
    """
    stops: list[tuple[np.ndarray, np.ndarray]] = []
    used = []
    for episode in episodes:
        topics = [
            topic
            for topic in episode.topics_of_type(schema.POSE_STAMPED)
            if topic.endswith(f"{CAMERAS}{camera_id}{TARGET_POSE}")
        ]
        samples = [PoseSample.from_cdr(message.data) for message in episode.messages(topics)]
        samples = [sample for sample in samples if np.isfinite(sample.T_frame_body).all()]
        if not samples:
            continue
        used.append(episode.info.id)
        stops += _stops(posture_track(episode), samples, link)
    hands, targets = np.array(stops).reshape(-1, 2, 4, 4).swapaxes(0, 1)
    return PosePairs(Ts_base_effector=hands, Ts_camera_target=targets, source=", ".join(used))


def _stops(
    track: PostureTrack, samples: list[PoseSample], link: str
) -> list[tuple[np.ndarray, np.ndarray]]:
    """One averaged pair for each stop of the robot; detections on the move are left out."""
    robot = load_robot(track.urdf)
    groups: list[tuple[np.ndarray, list[np.ndarray]]] = []
    for sample in sorted(samples, key=lambda item: item.stamp_ns):
        if not track.is_stationary(sample.stamp_ns):
            continue
        joints = track.at(sample.stamp_ns).joints_rad
        if groups and np.abs(groups[-1][0] - joints).max() < SAME_PLACE_RAD:
            groups[-1][1].append(sample.T_frame_body)
        else:
            groups.append((joints, [sample.T_frame_body]))
    means = [np.mean(Ts, axis=0) for _, Ts in groups]
    for T in means:
        T[:3, :3] = se3.nearest_rotation(T[:3, :3])  # the chordal mean
    return [(robot.T_base_link(link, q), T) for (q, _), T in zip(groups, means, strict=True)]


def calibrate_cameras(run: RunFolder, config: CalibrateConfig, output: Output) -> dict[str, Any]:
    """Find every camera the run has data of, and write ``scene/calibration.json``."""
    episodes = _readable(run, output)
    where = placement(episodes)
    urdf = next(filter(None, map(streams.robot_description, episodes)), "")
    robot = robot_of(urdf)
    link = "tool0" if 'name="tool0"' in urdf else robot.tool_frame
    config = replace(config, link=config.link or link)
    found: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    seen = sorted({*where, *target_cameras(episodes)})
    for camera_id in [config.camera] if config.camera else seen:
        try:
            moves = where.get(camera_id)
            found[camera_id] = _camera(episodes, camera_id, moves, config, robot.base_frame)
        except GstError as error:
            if config.camera:
                raise
            reasons[camera_id] = str(error)
            output.detail(f"camera {camera_id}: {error}")
    if not found:
        told = " ".join(f"{key}: {reason}" for key, reason in sorted(reasons.items()))
        nothing = f"no episode in {run.episodes_dir} has target poses or depth images of a camera. "
        nothing += "Record one of them."
        raise UsageError(f"no camera could be calibrated. {told}" if told else nothing)
    return write_calibration(run, found, reasons)


def _readable(run: RunFolder, output: Output) -> list[Episode]:
    """All episodes but those that cannot be opened, which are named."""
    episodes = []
    for path in run.episodes():
        try:
            episodes.append(Episode.open(path))
        except GstError as error:
            output.say(f"{path.stem}: {error}")
    return episodes


def _camera(
    episodes: Sequence[Episode],
    camera_id: str,
    moves: bool | None,
    config: CalibrateConfig,
    base: str,
) -> dict[str, Any]:
    if camera_id in target_cameras(episodes):
        pairs = recorded_pairs(episodes, camera_id, config.link)
        return target_record(pairs, config, base)
    topic = f"...{CAMERAS}{camera_id}{TARGET_POSE}"
    if moves is None:
        raise UsageError(
            f"camera {camera_id} has neither target poses (topic {topic}) "
            "nor depth images with intrinsics. Record one of them."
        )
    if moves:
        scans = [episode for episode in episodes if episode.info.kind == "scan"]
        try:
            return find_carried_camera(scans, camera_id, config.link)
        except GstError as error:
            raise UsageError(
                f"camera {camera_id} moves with the robot, there are no target poses of it, and "
                f"{error}. Record a target from 10 to 20 places on {topic}."
            ) from error
    with_depth = [episode for episode in episodes if camera_id in depth_cameras(episode)]
    return find_fixed_camera(with_depth, camera_id, base)


def target_record(pairs: PosePairs, config: CalibrateConfig, base: str) -> dict[str, Any]:
    """Say what pose pairs give."""
    solution, mount = find_camera(pairs, config.mount)
    found, names = asdict(solution), ("T_effector_target", "T_link_camera")
    names = ("T_link_camera", "T_base_target") if mount == "hand" else names
    X, Z = (se3.pose_record(found.pop(name)) for name in "XZ")
    return {
        "method": "target pose pairs, AX = ZB",
        "mount": mount,
        "link": config.link if mount == "hand" else base,
        "stream": "color",
        **dict(zip(names, (X, Z), strict=True)),
        **found,
        "residual_m": {"value": solution.residual_m},
        "sources": [pairs.source],
    }


def describe_cameras(record: Mapping[str, Any]) -> str:
    """Say in a line per camera what was identified and what was not."""
    lines = [f"calibration {record['calibration_id']} in scene/{CALIBRATION_FILE}"]
    lines += [f"{key}: {_describe(item)}" for key, item in record["cameras"].items()]
    lines += [f"{key}: not identified. {why}" for key, why in record["not_identified"].items()]
    return "\n".join(lines)


def _describe(item: Mapping[str, Any]) -> str:
    text = f"{item['mount']}, residual {item['residual_m']['value'] * 1e3:.2f} mm"
    if "residual_rad" in item:
        text += f" and {np.degrees(item['residual_rad']):.3f} degrees, {item['num_pairs']} pairs"
    if "sigma_m" in item:
        known_mm, outliers = item["sigma_m"] * 1e3, item["num_outliers"]
        return f"{text}, {outliers} outliers; position known to {known_mm:.2f} mm"
    if "fitness" in item:
        text += f", robot seen in {item['num_postures']} postures, fitness {item['fitness']:.2f}"
    text += f", depth scale {item['depth_scale']:.4f}"
    if "correction_m" in item:
        moved, turned = item["correction_m"] * 1e3, float(np.degrees(item["correction_rad"]))
        text += f"; {moved:.1f} mm and {turned:.2f} degrees from where the recording has it"
    return text
