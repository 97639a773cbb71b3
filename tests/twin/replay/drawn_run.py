"""A run to be drawn: a trial seen by a camera that stands and one in the hand, a scene of parts."""

import json

import numpy as np
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    FrameTransform,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.robots.default import ARM_JOINTS
from twin.replay.scene import ReplayScene
from twin.robot.model import load_robot
from twin.scene.gaussians import GaussianCloud, as_float32, write_ply
from twin.scene.robot.splats import write_links
from twin.scene.store.folder import background_hash, write_record

T0 = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
ARRIVED_NS = 3600 * SECOND
"""The recorder's clock is far from the sources'."""
LATE_NS = 80_000_000
"""Images are sent this long after they were taken."""
CAMERA = Camera(width=160, height=120, fx=130.0, fy=130.0, cx=80.0, cy=60.0)
WIDTH_M = 0.05
HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
AWAY = HOME + np.array([0.5, 0.1, 0.0, 0.0, 0.0, 0.0])
T_BASE_SIDE = se3.look_at(np.array([1.2, -0.8, 0.9]), np.array([0.45, 0.0, 0.22]), np.eye(3)[2])
T_TCP_WRIST = se3.transform_from(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, -0.08, -0.1]))
RED, GREEN, BLUE, GREY = (0.95, 0.02, 0.02), (0.02, 0.9, 0.02), (0.02, 0.02, 0.95), (0.3,) * 3


def cloud(points_m: np.ndarray, color: tuple[float, ...], radius_m: float = 0.005) -> GaussianCloud:
    count = len(points_m)
    return GaussianCloud(
        means_m=as_float32(points_m),
        quats_wxyz=as_float32(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))),
        scales_log=as_float32(np.full((count, 3), np.log(radius_m))),
        opacities_logit=as_float32(np.full(count, 5.0)),
        colors=as_float32(np.tile(color, (count, 1))),
    )


def block(size_m: float = 0.03) -> np.ndarray:
    steps = np.linspace(-size_m / 2, size_m / 2, 5)
    return np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)


def write_scene(run: RunFolder, scene: ReplayScene, movable: str, points_m: np.ndarray) -> None:
    """Grey far away, a red movable, a green container, a blue tool; scanned at other places."""
    run.scene_dir.mkdir()
    write_ply(run.scene_dir / "background.ply", cloud(np.array([[0.0, 3.0, 0.0]]), GREY))
    container = next(iter(scene.containers()))
    for name, color, points in ((movable, RED, points_m), (container, GREEN, block())):
        place = run.scene_dir / "objects" / name
        place.mkdir(parents=True)
        write_ply(place / "gaussians.ply", cloud(points, color))
        pose = {"p_m": [0.1, 0.5, 0.3], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
        (place / "object.json").write_text(json.dumps({"T_base_object": pose}))
    links = write_links(run, {"tool0": cloud(block(), BLUE)})
    record = {"schema_version": 1, "key": "k", "scene_hash": background_hash(run),
              "background": {}, "sources": [], "views": [], "robot": {"links": links},
              "objects": {movable: {}, container: {}}}  # fmt: skip
    write_record(run, record)


def write_recording(
    run: RunFolder,
    urdf: str,
    name: str = "trial_0001",
    *,
    home: np.ndarray = HOME,
    images: tuple[bytes, ...] = (*(b"-", *[b""] * 4) * 2, b"-"),
    **about: str,
) -> Episode:
    """A camera that stands, one in the hand; a motion over two seconds."""
    robot, path = load_robot(urdf), run.episodes_dir / f"{name}.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=name, kind="trial", task="cube_into_box", **about))

        def say(topic: str, data: bytes, kind: str, stamp: int) -> None:
            arrived = stamp + ARRIVED_NS
            writer.write(topic, data, type_name=kind, log_time_ns=arrived, publish_time_ns=stamp)

        say("/robot_description", string_to_cdr(urdf), schema.STRING, T0)
        for name in ("side", "wrist"):
            info = CameraInfo(stamp_ns=T0, frame_id=name, camera=CAMERA)
            say(f"/cell/cam/{name}/color/info", info.to_cdr(), schema.CAMERA_INFO, T0)
        for index, share in enumerate(np.linspace(0.0, 1.0, 11)):
            stamp = T0 + index * SECOND // 5
            joints = home + share * (AWAY - HOME)
            poses = {"side": T_BASE_SIDE, "wrist": robot.T_base_tcp(joints) @ T_TCP_WRIST}
            transforms = [
                FrameTransform(stamp_ns=stamp, parent="base_link", child=name, T_parent_child=T)
                for name, T in poses.items()
            ]
            say("/tf", transforms_to_cdr(transforms), schema.TF_MESSAGE, stamp)
            for topic, names, values in (
                ("joint_states", ARM_JOINTS, joints),
                ("gripper/state", ("gripper_width",), np.array([WIDTH_M])),
            ):
                sample = at_positions(stamp, names, values)
                say(f"/cell/{topic}", sample.to_cdr(), schema.JOINT_STATE, stamp)
            for name in poses if images[index] else ():
                image = CompressedColor(
                    stamp_ns=stamp, frame_id=name, format="jpeg", data=images[index]
                )
                topic, sent = f"/cell/cam/{name}/color/image", stamp + LATE_NS
                say(topic, image.to_cdr(), schema.COMPRESSED_IMAGE, sent)
    return Episode.open(path)
