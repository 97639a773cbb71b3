"""Draw the rebuilt scene, also in another state than scanned: objects moved, the robot posed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt16

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import ROBOT_DESCRIPTION
from bridge.episode.transforms import TransformTree
from bridge.errors import BridgeError, GstError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png
from bridge.robots.default import ARM_JOINTS, BASE_FRAME
from twin.robot.model import RobotDescriptionError, load_robot
from twin.robot.posture import Posture, posture_track
from twin.scene.frames.camera_poses import base_tree, calibrated_tree_at, unknown_mask
from twin.scene.frames.pairing import name_of
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud
from twin.scene.objects.decompose import compose_parts, read_objects, read_pose
from twin.scene.raster.backend import open_rasteriser
from twin.scene.raster.rasteriser import RasterConfig
from twin.scene.robot.splats import posed, read_links
from twin.scene.settings import RenderConfig
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import SCENE_FILE, Scene, read_scene

PROBES = 9
"""Instants of an episode at which a camera's place in the hand is looked at."""
RIGID_M = 0.01
"""A camera that stays this near to one place in the hand is mounted there."""
MOVED_M = 0.02
"""A hand that moved less says nothing about what it carries."""


@dataclass(frozen=True, kw_only=True)
class Composed:
    """What is drawn."""

    cloud: GaussianCloud
    robot: str
    """How the robot stands, or why it is not drawn."""
    posture: Posture | None
    """None: no robot is drawn."""


def compose(
    run: RunFolder, scene: Scene, episode: Episode, stamp_ns: int, config: RenderConfig
) -> Composed:
    """Put background, objects and robot together as the settings say.

    Args:
        run: Whose scene folder is read.
        scene: The background.
        episode: Says where the joints were.
        stamp_ns: When.
        config: ``joints``, ``width_m`` and ``object``.

    Raises:
        UsageError: An object that the scene does not have, a pose that is none, or joints for a
            robot that the scene does not have.
        RobotDescriptionError: The episode does not describe the robot.
    """
    objects = read_objects(run, scene.record)
    places = object_places(config.object, list(objects))
    cloud = compose_parts(scene.background, objects, places)
    links = read_links(run, scene.record)
    if not links:
        remark = scene.record.get("robot", {}).get("remark")
        reason = "the scene has no robot splats" + (f" ({remark})" if remark else "")
        if config.joints is not None:
            message = f"--joints cannot be followed: {reason}."
            raise UsageError(message)
        return Composed(cloud=cloud, robot=f"not drawn: {reason}", posture=None)
    try:
        urdf, posture = _posture(episode, stamp_ns, config)
    except GstError as error:
        if config.joints is not None:
            raise
        return Composed(cloud=cloud, robot=f"not drawn: {error}", posture=None)
    robot = posed(links, posture.joints_rad, urdf, width_m=posture.width_m)
    root = scene.record["robot"].get("T_base_root")
    if root is not None:
        T_base_root = read_pose(root, run.scene_dir / SCENE_FILE)
        robot = moved_cloud(robot, se3.invert(T_base_root))
    source = "given" if config.joints is not None else f"as {episode.info.id} has it at that time"
    return Composed(cloud=concatenate([cloud, robot]), robot=f"joints {source}", posture=posture)


def _posture(episode: Episode, stamp_ns: int, config: RenderConfig) -> tuple[str, Posture]:
    if config.joints is None:
        track = posture_track(episode)
        if not track.covers(stamp_ns):
            message = f"{episode.info.id} has no joints at that time: choose another --at-s."
            raise UsageError(message)
        recorded = track.at(stamp_ns)
        width_m = recorded.width_m if config.width_m is None else config.width_m
        return track.urdf, Posture(joints_rad=recorded.joints_rad, width_m=width_m)
    joints = np.array(config.joints, dtype=np.float64)
    if len(joints) != len(ARM_JOINTS) or not np.isfinite(joints).all():
        message = f"--joints takes {len(ARM_JOINTS)} angles in rad: {', '.join(ARM_JOINTS)}."
        raise UsageError(message)
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise RobotDescriptionError(
            found=f"is missing in episode {episode.info.id}",
            hint=f"Choose an --episode that has {ROBOT_DESCRIPTION}.",
        )
    return urdf, Posture(joints_rad=joints, width_m=config.width_m or 0.0)


def object_places(
    texts: Sequence[str], known: Sequence[str]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Read ``ID=x,y,z`` or ``ID=x,y,z,qw,qx,qy,qz``: where objects are to be, in the scene's frame.

    Args:
        texts: One per object; the last word on an object counts.
        known: Objects of the scene.

    Raises:
        UsageError: Another object, or numbers that are no pose.
    """
    places = {}
    for text in texts:
        object_id, _, listed = text.partition("=")
        if object_id not in known:
            there = ", ".join(known) or "none"
            message = f"--object {text!r}: the scene has no object {object_id!r}. It has: {there}."
            raise UsageError(message)
        places[object_id] = _pose_from(text, listed)
    return places


def _pose_from(text: str, listed: str) -> Float[np.ndarray, "4 4"]:
    try:
        numbers = np.array([float(word) for word in listed.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) == 3:
        numbers = np.concatenate([numbers, [1.0, 0.0, 0.0, 0.0]])
    if len(numbers) != 7 or not np.isfinite(numbers).all() or not numbers[3:].any():
        message = (
            f"--object {text!r} is not a pose: write ID=x,y,z or ID=x,y,z,qw,qx,qy,qz, in metres."
        )
        raise UsageError(message)
    return se3.transform_from(numbers[3:] / np.linalg.norm(numbers[3:]), numbers[:3])


def carried_camera(
    episode: Episode,
    frame_id: str,
    joints_rad: Float[np.ndarray, " num_joints"],
    tree: TransformTree | None = None,
) -> Float[np.ndarray, "4 4"] | None:
    """Where a camera in the robot's hand would be in a posture, ``T_base_camera``.

    Args:
        episode: Shows whether the camera moves with the hand.
        frame_id: The camera's frame.
        joints_rad: The posture.
        tree: Says where the camera was; None: ``/tf`` does.

    Returns:
        None when the camera is not seen to move with the hand.
    """
    try:
        track = posture_track(episode)
    except GstError:
        return None
    tree = base_tree(episode) if tree is None else tree
    robot = load_robot(track.urdf)
    # By the source's clock, which may have little to do with when messages arrived; and where the
    # camera's pose was stated, because in a fast motion what lies between may be off by much.
    posed_ns = np.array([t for t in tree.stamps_ns(frame_id).tolist() if track.covers(t)])
    stamps = posed_ns[
        np.linspace(0, len(posed_ns) - 1, min(PROBES, len(posed_ns))).round().astype(int)
    ]
    pairs = [
        (robot.T_base_tcp(track.at(stamp).joints_rad), tree.T_root_frame(frame_id, stamp))
        for stamp in stamps.tolist()
        if track.covers(stamp)
    ]
    mounted = np.array([se3.invert(hand) @ camera for hand, camera in pairs]).reshape(-1, 4, 4)
    hands = np.array([hand for hand, _ in pairs]).reshape(-1, 4, 4)
    if len(pairs) == 0 or _spread(hands) < MOVED_M or _spread(mounted) > RIGID_M:
        return None
    return np.asarray(robot.T_base_tcp(joints_rad) @ mounted[len(mounted) // 2])


def _spread(Ts: Float[np.ndarray, "num_poses 4 4"]) -> float:
    return float(np.linalg.norm(np.ptp(Ts[:, :3, 3], axis=0)))


def describe_drawn(drawn: Mapping[str, object]) -> str:
    """The files, and what a reader should know about the robot in them."""
    files = drawn["files"]
    lines = [str(path) for path in files] if isinstance(files, list) else []
    return "\n".join([*lines, f"robot: {drawn['robot']}"])


UP = np.array([0.0, 0.0, 1.0])
"""The root frame's z axis points up (table top at z = 0)."""


def render(run: RunFolder, config: RenderConfig) -> dict[str, Any]:
    """Write one PNG of the scene and return what was drawn.

    Args:
        run: Whose scene is drawn.
        config: Camera, time, joints, places of objects, and where the files go.

    Raises:
        UsageError: When the episode, the camera or an object is unknown (lists those that exist),
            joints are given for a robot that the scene does not have, or nothing says where the
            camera was in the scene at that time.
        MissingDependencyError: When the backend cuda was asked for and cannot run here.
    """
    rasteriser = open_rasteriser(RasterConfig(backend=config.backend))
    scene = read_scene(run)
    episode = _episode(run, scene, config.episode)
    camera_id = _camera_id(episode, config.camera)
    first_ns = streams.first_stamp_ns(episode)
    began_ns = episode.start_ns if first_ns is None else first_ns
    stamp_ns = began_ns + round(config.at_s * 1e9)
    composed = compose(run, scene, episode, stamp_ns, config)
    camera, T_base_camera = _view_of(run, scene, episode, camera_id, stamp_ns, config)
    view = rasteriser.view(composed.cloud, camera, T_base_camera)
    path = config.out or run.results_dir / "render.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(view.image_u8()))
    written = [str(path)]
    if config.depth:
        depth_path = path.with_name(f"{path.stem}_depth{path.suffix}")
        depth_path.write_bytes(encode_png(_millimetres(view.depth_m)))
        written.append(str(depth_path))
    return {
        "files": written,
        "scene_hash": scene.scene_hash,
        "episode": episode.info.id,
        "camera": camera_id,
        "robot": composed.robot,
        "coverage_fraction": float(view.alpha.mean()),
    }


def _millimetres(depth_m: Float32[np.ndarray, "height width"]) -> UInt16[np.ndarray, "_ _"]:
    """Whole millimetres; what is farther away than they can say is as far as they can."""
    largest = np.iinfo(np.uint16).max
    return np.clip(np.rint(depth_m * 1e3), 0, largest).astype(np.uint16)


def _episode(run: RunFolder, scene: Scene, wanted: str) -> Episode:
    name = wanted or scene.record["sources"][0]["id"]
    episodes: dict[str, Episode] = {}
    for path in run.episodes():
        try:
            episode = Episode.open(path)
        except BridgeError:
            if path.stem == name:
                raise
        else:
            episodes[episode.info.id] = episode
    if name not in episodes:
        message = f"no episode {name!r} in {run.path}. There are: {', '.join(episodes) or 'none'}."
        raise UsageError(message)
    return episodes[name]


def _camera_id(episode: Episode, wanted: str) -> str:
    ids = streams.camera_ids(episode)
    if not ids or (wanted and wanted not in ids):
        found = ", ".join(ids) or "none"
        message = f"no camera {wanted!r} in episode {episode.info.id}. There are: {found}."
        raise UsageError(message)
    return wanted or ids[0]


def _view_of(
    run: RunFolder,
    scene: Scene,
    episode: Episode,
    camera_id: str,
    stamp_ns: int,
    config: RenderConfig,
) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
    info = streams.camera_info(episode, camera_id)
    if (config.eye is None) != (config.target is None):
        message = "--eye and --target belong together: where to stand, and what to look at."
        raise UsageError(message)
    if config.eye is not None and config.target is not None:
        eye, target = np.array(config.eye), np.array(config.target)
        if np.linalg.norm(np.cross(target - eye, UP)) < 1e-6:
            message = "--eye is straight above or below --target; move it a little sideways."
            raise UsageError(message)
        return info.camera, se3.look_at(eye, target, UP)
    tree = _tree_of(run, scene, episode, camera_id, stamp_ns)
    is_known = info.frame_id in tree.frames()
    root = tree.root_of(info.frame_id) if is_known else None
    if root != scene.record.get("frame", root) or root is None:
        message = (
            f"nothing says where {name_of(episode, camera_id)} was in the scene's frame "
            f"{scene.record.get('frame')!r}: say where to stand with --eye and --target."
        )
        raise UsageError(message)
    if config.joints is not None and root == BASE_FRAME:
        T_base_camera = carried_camera(episode, info.frame_id, np.array(config.joints), tree)
        if T_base_camera is not None:
            return info.camera, T_base_camera
    if unknown_mask(tree, [info.frame_id], np.array([stamp_ns]))[0]:
        message = (
            f"nobody recorded where {name_of(episode, camera_id)} was at --at-s {config.at_s:g}: "
            "choose another time, or say where to stand with --eye and --target."
        )
        raise UsageError(message)
    return info.camera, tree.T_root_frame(info.frame_id, stamp_ns)


def _tree_of(
    run: RunFolder, scene: Scene, episode: Episode, camera_id: str, stamp_ns: int
) -> TransformTree:
    """Poses of a camera, from where the scene has its own."""
    known = scene.record.get("cameras", [])
    if not any((item["id"], item["poses_from"]) == (camera_id, "hand-eye") for item in known):
        return base_tree(episode)
    calibration = read_calibration(run)
    place = None if calibration is None else calibration.cameras.get(camera_id)
    if place is None:
        return base_tree(episode)
    return calibrated_tree_at(episode, camera_id, place, np.array([stamp_ns]))
