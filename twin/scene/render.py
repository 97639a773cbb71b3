"""Draw the rebuilt scene, also in another state than scanned: objects moved, the robot posed."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, UInt16

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import ROBOT_DESCRIPTION
from bridge.episode.transforms import TransformTree
from bridge.errors import BridgeError, GstError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png
from twin.robot.model import RobotDescriptionError, load_robot
from twin.robot.posture import Posture, posture_track
from twin.scene.frames.camera_poses import base_tree, calibrated_tree_at, unknown_mask
from twin.scene.frames.pairing import name_of
from twin.scene.raster.backend import open_rasteriser
from twin.scene.raster.rasteriser import RasterConfig
from twin.scene.settings import RenderConfig
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import Scene, read_scene
from twin.scene.trial import TrialInScene, open_trial

PROBES = 9
"""Instants of an episode at which a camera's place in the hand is looked at."""
RIGID_M = 0.01
"""A camera that stays this near to one place in the hand is mounted there."""
MOVED_M = 0.02
"""A hand that moved less says nothing about what it carries."""


def posture_of(
    trial: TrialInScene, stamp_ns: int, config: RenderConfig
) -> tuple[Posture | None, str, str]:
    """How the robot stands: posture or None, its URDF, and where that comes from or why not."""
    if config.joints is not None:
        if not trial.parts.links:
            message = f"--joints cannot be followed: {trial.robot.removeprefix('not drawn: ')}."
            raise UsageError(message)
        return _given_posture(trial.recorded, config.joints, config.width_m)
    track, of = trial.postures, trial.recorded.info.id
    if track is None or not trial.parts.links:
        return None, "", trial.robot
    if not track.covers(stamp_ns):
        return None, "", f"not drawn: {of} has no joints at that time: choose another --at-s."
    recorded = track.at(stamp_ns)
    width_m = recorded.width_m if config.width_m is None else config.width_m
    posture = Posture(joints_rad=recorded.joints_rad, width_m=width_m)
    return posture, track.urdf, f"joints as {of} has them at that time"


def _given_posture(
    episode: Episode, given: Sequence[float], width_m: float | None
) -> tuple[Posture, str, str]:
    joints = np.array(given, dtype=np.float64)
    names = streams.recorded_robot(episode).joints
    if len(joints) != len(names) or not np.isfinite(joints).all():
        message = f"--joints takes {len(names)} angles in rad: {', '.join(names)}."
        raise UsageError(message)
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise RobotDescriptionError(
            found=f"is missing in episode {episode.info.id}",
            hint=f"Choose an --episode that has {ROBOT_DESCRIPTION}.",
        )
    return Posture(joints_rad=joints, width_m=width_m or 0.0), urdf, "joints given"


def object_places(
    texts: Sequence[str], known: Sequence[str]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Read ``ID=x,y,z`` or ``ID=x,y,z,qw,qx,qy,qz``: where objects are to be, in the scene's frame.

    Args:
        texts: One per object; the last word on an object counts.
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


def describe_drawn(drawn: Mapping[str, Any]) -> str:
    """The files, and what a reader should know about what they show."""
    return "\n".join([*drawn["files"], f"robot: {drawn['robot']}", *drawn["notes"]])


UP = np.array([0.0, 0.0, 1.0])
"""The root frame's z axis points up (table top at z = 0)."""


def render(run: RunFolder, config: RenderConfig) -> dict[str, Any]:
    """Write one image of the scene, and return what was drawn."""
    rasteriser = open_rasteriser(RasterConfig(backend=config.backend))
    scene = read_scene(run)
    episode = episode_of(run, scene, config.episode)
    camera_id = camera_of(episode, config.camera)
    first_ns = streams.first_stamp_ns(episode)
    began_ns = episode.start_ns if first_ns is None else first_ns
    stamp_ns = began_ns + round((config.at_s or 0.0) * 1e9)
    trial = open_trial(run, scene, episode)
    moved = object_places(config.object, list(trial.parts.objects))
    posture, urdf, robot = posture_of(trial, stamp_ns, config)
    camera, T_base_camera = _view_of(run, scene, episode, camera_id, stamp_ns, config)
    if chosen_view(config) is None:
        T_base_camera = trial.registered(camera_id, T_base_camera)
    places = trial.places(stamp_ns) | moved
    cloud = trial.parts.at(places, posture, urdf)
    drawn = trial.parts.draw(rasteriser, cloud, camera, T_base_camera)
    path = config.out or run.results_dir / "render.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(drawn.marked_u8()))
    written = [str(path)]
    if config.depth:
        for ending, image in (("depth", depth_image(drawn.depth_m)), ("seen", drawn.seen_u8())):
            beside = path.with_name(f"{path.stem}_{ending}.png")
            beside.write_bytes(encode_png(image))
            written.append(str(beside))
    return {
        "files": written,
        "scene_hash": scene.scene_hash,
        "episode": episode.info.id,
        "camera": camera_id,
        "robot": robot,
        "notes": list(trial.notes),
        "not_scanned": sorted(trial.parts.not_scanned),
        "coverage_fraction": float(drawn.alpha.mean()),
    }


def depth_image(depth_m: Float32[np.ndarray, "height width"]) -> UInt16[np.ndarray, "_ _"]:
    """Whole millimetres; what is farther away than they can say is as far as they can."""
    largest = np.iinfo(np.uint16).max
    return np.clip(np.rint(depth_m * 1e3), 0, largest).astype(np.uint16)


def episode_of(run: RunFolder, scene: Scene, wanted: str) -> Episode:
    """Open a recorded episode of a run by its id."""
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


def camera_of(episode: Episode, wanted: str) -> str:
    """The camera of an episode that is wanted, or the first."""
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
    camera = sized_camera(info.camera, config.size)
    T_chosen = chosen_view(config)
    if T_chosen is not None:
        return camera, T_chosen
    tree = poses_in_scene(run, scene, episode, camera_id, np.array([stamp_ns]))
    root = tree.root_of(info.frame_id)
    if config.joints is not None and root == streams.recorded_robot(episode).base_frame:
        T_base_camera = carried_camera(episode, info.frame_id, np.array(config.joints), tree)
        if T_base_camera is not None:
            return camera, T_base_camera
    if unknown_mask(tree, [info.frame_id], np.array([stamp_ns]))[0]:
        at_s = config.at_s or 0.0
        message = (
            f"nobody recorded where {name_of(episode, camera_id)} was at --at-s {at_s:g}: "
            "choose another time, or say where to stand with --eye and --target."
        )
        raise UsageError(message)
    return camera, tree.T_root_frame(info.frame_id, stamp_ns)


def chosen_view(config: RenderConfig) -> Float[np.ndarray, "4 4"] | None:
    """Where ``--eye`` and ``--target`` put a camera; None without them."""
    if config.eye is None and config.target is None:
        return None
    if config.eye is None or config.target is None:
        message = "--eye and --target belong together: where to stand, and what to look at."
        raise UsageError(message)
    eye, target = np.array(config.eye), np.array(config.target)
    if np.linalg.norm(np.cross(target - eye, UP)) < 1e-6:
        message = "--eye is straight above or below --target; move it a little sideways."
        raise UsageError(message)
    return se3.look_at(eye, target, UP)


def sized_camera(camera: Camera, size: str) -> Camera:
    """The same view as an image of another size: all of it is seen, more only beside it."""
    if not size:
        return camera
    words = size.lower().split("x")
    if len(words) != 2 or not all(word.isdigit() and 16 <= int(word) <= 8192 for word in words):
        message = f"--size {size!r} is no size: write WIDTHxHEIGHT, each 16 to 8192 pixels."
        raise UsageError(message)
    width, height = (int(word) for word in words)
    factor = min(width / camera.width, height / camera.height)
    return Camera(
        width=width,
        height=height,
        fx=camera.fx * factor,
        fy=camera.fy * factor,
        cx=camera.cx * factor + (width - camera.width * factor) / 2,
        cy=camera.cy * factor + (height - camera.height * factor) / 2,
    )


def poses_in_scene(
    run: RunFolder,
    scene: Scene,
    episode: Episode,
    camera_id: str,
    stamps_ns: Int[np.ndarray, " num_stamps"],
) -> TransformTree:
    """Poses of a camera in the scene's frame, from where the scene has its own."""
    tree = _tree_of(run, scene, episode, camera_id, stamps_ns)
    frame_id = streams.camera_info(episode, camera_id).frame_id
    root = tree.root_of(frame_id) if frame_id in tree.frames() else None
    if root != scene.record.get("frame", root) or root is None:
        message = (
            f"nothing says where {name_of(episode, camera_id)} was in the scene's frame "
            f"{scene.record.get('frame')!r}: say where to stand with --eye and --target."
        )
        raise UsageError(message)
    return tree


def _tree_of(
    run: RunFolder,
    scene: Scene,
    episode: Episode,
    camera_id: str,
    stamps_ns: Int[np.ndarray, " num_stamps"],
) -> TransformTree:
    known = scene.record.get("cameras", [])
    if not any((item["id"], item["poses_from"]) == (camera_id, "hand-eye") for item in known):
        return base_tree(episode)
    calibration = read_calibration(run)
    place = None if calibration is None else calibration.cameras.get(camera_id)
    if place is None:
        return base_tree(episode)
    return calibrated_tree_at(episode, camera_id, place, stamps_ns)
