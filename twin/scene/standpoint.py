"""From where an episode is drawn: its cameras as the scene has them, or a place of one's own."""

import numpy as np
from jaxtyping import Float, Int

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.transforms import TransformTree
from bridge.errors import BridgeError, GstError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.robot.model import load_robot
from twin.robot.posture import posture_track
from twin.scene.frames.camera_poses import base_tree, calibrated_tree_at, unknown_mask
from twin.scene.frames.pairing import name_of
from twin.scene.frames.selection import spread
from twin.scene.settings import RenderConfig
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import Scene
from twin.scene.trial import TrialInScene

PROBES = 9
"""Instants of an episode at which a camera's place in the hand is looked at."""
RIGID_M = 0.01
"""A camera that stays this near to one place in the hand is mounted there."""
MOVED_M = 0.02
"""A hand that moved less says nothing about what it carries."""
UP = np.array([0.0, 0.0, 1.0])
"""The root frame's z axis points up (table top at z = 0)."""


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


def camera_places(
    run: RunFolder,
    scene: Scene,
    trial: TrialInScene,
    camera_id: str,
    stamps_ns: Int[np.ndarray, " num_stamps"],
    config: RenderConfig,
) -> list[Float[np.ndarray, "4 4"] | None]:
    """Where to draw from at some instants; None where nobody recorded where the camera was."""
    T_chosen = chosen_view(config)
    if T_chosen is not None:
        return [T_chosen] * len(stamps_ns)
    episode = trial.recorded
    tree = poses_in_scene(run, scene, episode, camera_id, stamps_ns)
    frame_id = streams.camera_info(episode, camera_id).frame_id
    unknown = unknown_mask(tree, [frame_id], stamps_ns)
    return [
        None if is_unknown else trial.registered(camera_id, tree.T_root_frame(frame_id, stamp_ns))
        for stamp_ns, is_unknown in zip(stamps_ns.tolist(), unknown.tolist(), strict=True)
    ]


def carried_camera(
    episode: Episode,
    frame_id: str,
    joints_rad: Float[np.ndarray, " num_joints"],
    tree: TransformTree,
) -> Float[np.ndarray, "4 4"] | None:
    """Where a camera in the robot's hand would be in a posture, ``T_base_camera``.

    Returns:
        None when the camera is not seen to move with the hand.
    """
    try:
        track = posture_track(episode)
    except GstError:
        return None
    robot = load_robot(track.urdf)
    # By the source's clock, which may have little to do with when messages arrived; and where the
    # camera's pose was stated, because in a fast motion what lies between may be off by much.
    posed_ns = np.array([t for t in tree.stamps_ns(frame_id).tolist() if track.covers(t)])
    pairs = [
        (robot.T_base_tcp(track.at(stamp).joints_rad), tree.T_root_frame(frame_id, stamp))
        for stamp in spread(posed_ns, PROBES).tolist()
    ]
    mounted = np.array([se3.invert(hand) @ camera for hand, camera in pairs]).reshape(-1, 4, 4)
    hands = np.array([hand for hand, _ in pairs]).reshape(-1, 4, 4)
    if len(pairs) == 0 or _spread(hands) < MOVED_M or _spread(mounted) > RIGID_M:
        return None
    return np.asarray(robot.T_base_tcp(joints_rad) @ mounted[len(mounted) // 2])


def _spread(Ts: Float[np.ndarray, "num_poses 4 4"]) -> float:
    return float(np.linalg.norm(np.ptp(Ts[:, :3, 3], axis=0)))


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
    by_hand = [c["id"] for c in scene.record.get("cameras", []) if c["poses_from"] == "hand-eye"]
    calibration = read_calibration(run)
    place = calibration.cameras.get(camera_id) if calibration and camera_id in by_hand else None
    if place is None:
        return base_tree(episode)
    return calibrated_tree_at(episode, camera_id, place, stamps_ns)
