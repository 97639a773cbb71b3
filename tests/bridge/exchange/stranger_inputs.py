"""What strangers come with, each as small as it can be: bags, datasets, folders, tables, a run."""

import json
import sqlite3
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from bridge.episode.reader import Episode
from bridge.episode.schema import ROS_TYPES, schema_text
from bridge.media.color import encode_jpeg, encode_png

CAMERA = ("color/image", "color/info", "depth/image", "depth/info")
POSES = {"/tf": "/tf", "/tf_static": "/tf_static"}
DRIVERS = {
    "realsense": (
        "/camera/camera/color/image_raw/compressed",
        "/camera/camera/color/camera_info",
        "/camera/camera/aligned_depth_to_color/image_raw",
        "/camera/camera/aligned_depth_to_color/camera_info",
    ),
    "zed": (
        "/zed/zed_node/rgb/image_rect_color/compressed",
        "/zed/zed_node/rgb/camera_info",
        "/zed/zed_node/depth/depth_registered",
        "/zed/zed_node/depth/camera_info",
    ),
    "azure": (
        "/rgb/image_raw/compressed",
        "/rgb/camera_info",
        "/depth_to_rgb/image_raw",
        "/depth_to_rgb/camera_info",
    ),
}
"""Topics of three drivers' colour and depth, each with its calibration."""
PANDA = tuple(f"panda_joint{n}" for n in range(1, 8))


def driver_names(driver: str, camera: str) -> dict[str, str]:
    """New names by those of an episode of the cell ``lab``."""
    topics = zip(CAMERA, DRIVERS[driver], strict=True)
    return {f"/lab/cam/{camera}/{ours}": theirs for ours, theirs in topics} | POSES


def mcap_bag(episode: Path, path: Path, names: Mapping[str, str]) -> Path:
    """The messages of some topics of an episode, as ``ros2 bag record`` writes them."""
    opened = Episode.open(episode)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        channels = {}
        for topic, about in opened.topics().items():
            if topic in names:
                text = schema_text(about.type_name).encode()
                kind = writer.register_schema(about.type_name, "ros2msg", text)
                channels[topic] = writer.register_channel(names[topic], "cdr", kind)
        for item in opened.messages(channels):
            channel = channels[item.topic]
            writer.add_message(channel, item.log_time_ns, item.data, item.publish_time_ns)
        writer.finish()
    return path


def sqlite_bag(episode: Path, folder: Path, names: Mapping[str, str]) -> Path:
    """The same as a folder with a database and ``metadata.yaml``."""
    opened = Episode.open(episode)
    folder.mkdir()
    database = sqlite3.connect(folder / "b_0.db3")
    database.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
        "serialization_format TEXT, offered_qos_profiles TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB);"
    )
    numbers = {topic: number for number, topic in enumerate(names, start=1)}
    for topic, number in numbers.items():
        type_name = opened.topics()[topic].type_name
        assert type_name in ROS_TYPES
        row = (number, names[topic], type_name, "cdr", "")
        database.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", row)
    for item in opened.messages(names):
        row = (numbers[item.topic], item.log_time_ns, bytes(item.data))
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    database.commit()
    database.close()
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n"
        "  relative_file_paths:\n    - b_0.db3\n"
    )
    return folder


def rlds(folder: Path) -> Path:
    """A dataset as TensorFlow Datasets keeps it."""
    version = folder / "1.0.0"
    version.mkdir(parents=True)
    record: dict[str, Any] = {"name": "bridge", "version": "1.0.0"}
    record["splits"] = [{"name": "train", "shardLengths": ["3", "4"]}]
    (version / "dataset_info.json").write_text(json.dumps(record))
    (version / "features.json").write_text("{}")
    (version / "bridge-train.tfrecord-00000-of-00001").write_bytes(bytes(64))
    return folder


def posed(folder: Path) -> Path:
    """Two images with depth and their poses, as NeRF programs keep them."""
    folder.mkdir(exist_ok=True)
    frames = []
    for number in (1, 2):
        picture = encode_jpeg(np.full((24, 32, 3), 60 * number, np.uint8))
        (folder / f"{number}.jpg").write_bytes(picture)
        (folder / f"{number}.png").write_bytes(encode_png(np.full((24, 32), 900, np.uint16)))
        names = {"file_path": f"{number}.jpg", "depth_file_path": f"{number}.png"}
        frames.append({**names, "transform_matrix": np.eye(4).tolist()})
    about = {"w": 32, "h": 24, "fl_x": 30, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about))
    return folder


def workbook(path: Path) -> Path:
    """A spreadsheet as a laboratory keeps it: its own words, no ids."""
    from openpyxl import Workbook

    book = Workbook()
    rows = [("Task", "Policy", "Outcome"), *[("stack", "act", "success")] * 3]
    for row in (*rows, ("stack", "act", "failure")):
        book.active.append(row)
    book.save(path)
    return path


def splat(path: Path, *, fields: str = "x y z f_dc_0 opacity scale_0 rot_0") -> Path:
    """A PLY file of five points with some fields."""
    names = fields.split()
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    path.write_bytes(head.encode() + bytes(4 * 5 * len(names)))
    return path


def franka(make_trial: Callable[..., Path], folder: Path) -> Path:
    """A Franka arm without cameras, in a database."""
    trial = make_trial(id="arm", kind="imported", task="", cameras=(), joints=PANDA, result=None)
    return sqlite_bag(trial, folder, {"/lab/joint_states": "/franka/joint_states"})


def camera_bag(make_trial: Callable[..., Path], path: Path, driver: str) -> Path:
    """A camera of a driver, posed, and an arm of six joints that nobody knows."""
    trial = make_trial(id=driver, joints=tuple("abcdef"))
    names = driver_names(driver, "wrist") | {"/lab/joint_states": "/joint_states"}
    return mcap_bag(trial, path, names)


REALSENSE = ("/camera/camera/color", "/camera/camera/aligned_depth_to_color")


def xarm(
    folder: Path,
    joints: int,
    *,
    arm: str = "/xarm",
    camera: tuple[str, str] = REALSENSE,
    gripper: str = "",
) -> Path:
    """An xArm with its driver's joint states and a RealSense in the hand, by rosbags alone.

    The gripper's joint is said with the others, or, ours, by a driver of its own.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    msgs = store.types
    color, depth = camera
    arms = [f"joint{n}" for n in range(1, joints + 1)]
    fingers = ["gripper_left_finger_joint" if gripper else "drive_joint"]
    image = np.zeros((24, 32, 3), np.uint8)
    depth_mm = np.full((24, 32), 500, "<u2")

    def header(ns: int, frame: str) -> Any:
        stamp = msgs["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return msgs["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def picture(ns: int, encoding: str, data: np.ndarray) -> Any:
        return msgs["sensor_msgs/msg/Image"](
            header=header(ns, "camera_color_optical_frame"),
            height=24,
            width=32,
            encoding=encoding,
            is_bigendian=0,
            step=data.strides[0],
            data=data.view(np.uint8).ravel(),
        )

    def lens(ns: int) -> Any:
        region = msgs["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, do_rectify=False)
        return msgs["sensor_msgs/msg/CameraInfo"](
            header=header(ns, "camera_color_optical_frame"),
            height=24,
            width=32,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=np.array([30.0, 0, 16, 0, 30, 12, 0, 0, 1]),
            r=np.eye(3).ravel(),
            p=np.array([30.0, 0, 16, 0, 0, 30, 12, 0, 0, 0, 1, 0]),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def turned(ns: int, names: list[str]) -> Any:
        return msgs["sensor_msgs/msg/JointState"](
            header=header(ns, ""),
            name=names,
            position=np.full(len(names), ns % 10**9 * 1e-9),
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )

    def mounted(ns: int) -> Any:
        turn = msgs["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        place = msgs["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.1)
        motion = msgs["geometry_msgs/msg/Transform"](translation=place, rotation=turn)
        one = msgs["geometry_msgs/msg/TransformStamped"](
            header=header(ns, "link_eef"),
            child_frame_id="camera_color_optical_frame",
            transform=motion,
        )
        return msgs["tf2_msgs/msg/TFMessage"](transforms=[one])

    said = {
        f"{arm}/joint_states": (10, partial(turned, names=arms + fingers * (not gripper))),
        **({f"{gripper}/joint_states": (20, partial(turned, names=fingers))} if gripper else {}),
        f"{color}/image_raw": (100, lambda ns: picture(ns, "rgb8", image)),
        f"{color}/camera_info": (100, lens),
        f"{depth}/image_raw": (
            100,
            lambda ns: picture(ns, "16UC1", depth_mm),
        ),
        f"{depth}/camera_info": (100, lens),
        "/tf_static": (1000, mounted),
    }
    with Writer2(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        channels = {
            topic: writer.add_connection(topic, make(0).__msgtype__, typestore=store)
            for topic, (_, make) in said.items()
        }
        for step_ms in range(0, 1000, 10):
            ns = 1_760_000_000_000_000_000 + step_ms * 10**6
            for topic, (every_ms, make) in said.items():
                if step_ms % every_ms == 0:
                    message = make(ns)
                    data = store.serialize_cdr(message, message.__msgtype__)
                    writer.write(channels[topic], ns, data)
    return folder
