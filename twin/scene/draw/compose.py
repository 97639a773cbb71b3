"""A scene in another state than the scanned one: objects moved, the robot in a given posture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.transforms import TransformTree
from bridge.errors import GstError, UsageError
from bridge.geometry import se3
from bridge.task.robot import ARM_JOINTS
from twin.robot.model import RobotDescriptionError, load_robot
from twin.robot.posture import Posture, posture_track
from twin.scene.frames.base import base_tree
from twin.scene.gaussians.cloud import GaussianCloud, concatenate
from twin.scene.gaussians.moved import moved_cloud
from twin.scene.objects.parts import put_together, read_objects, read_pose
from twin.scene.robot.splats import posed, read_links
from twin.scene.settings import RenderConfig
from twin.scene.store.folder import SCENE_FILE, Scene

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
    """How the robot stands, or in one sentence why it is not drawn."""
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
    cloud = put_together(scene.background, objects, places)
    links = read_links(run, scene.record)
    if not links:
        reason = "the scene has no robot splats" + _because(scene)
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
    said = "given" if config.joints is not None else f"as {episode.info.id} has it at that time"
    return Composed(cloud=concatenate([cloud, robot]), robot=f"joints {said}", posture=posture)


def _because(scene: Scene) -> str:
    remark = scene.record.get("robot", {}).get("remark")
    return f" ({remark})" if remark else ""


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
            hint="Choose an --episode that has /robot_description.",
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
    stated = np.array([t for t in tree.stamps_ns(frame_id).tolist() if track.covers(t)])
    stamps = stated[np.linspace(0, len(stated) - 1, min(PROBES, len(stated))).round().astype(int)]
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
