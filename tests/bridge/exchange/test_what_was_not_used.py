"""Imports name what they do not use, and take the names that camera drivers give."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import robot_gst
from bridge.episode import schema
from bridge.episode.reader import Episode
from bridge.episode.schema import DEFINITIONS
from bridge.exchange.driver_names import mapped
from bridge.media.color import encode_png

IMAGE, INFO = schema.IMAGE, schema.CAMERA_INFO
JPEG = schema.COMPRESSED_IMAGE


def bag(path: Path, channels: list[tuple[str, str, str, str]]) -> Path:
    """One message on each channel: topic, type, encoding of its messages and of its definition."""
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    for number, (topic, name, encoding, text) in enumerate(channels):
        definition = DEFINITIONS.get(name, "") if text == "ros2msg" else "float64 data"
        kind = writer.register_schema(name, text, definition.encode())
        channel = writer.register_channel(topic, encoding, kind)
        writer.add_message(channel, number, b"\0\1\0\0" + bytes(8), number)
    writer.finish()
    path.write_bytes(stream.getvalue())
    return path


def test_messages_of_ros_1_are_kept_and_said_not_to_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = bag(
        tmp_path / "a.mcap",
        [
            ("/joint_states", "sensor_msgs/JointState", "ros1", "ros1msg"),
            ("/tf", schema.TF_MESSAGE, "cdr", "ros2msg"),
            ("/width", "std_msgs/msg/Float64", "cdr", "ros2msg"),
        ],
    )
    run = tmp_path / "run"
    assert robot_gst.run(["import", "rosbag2", str(made), str(run), "--json"]) == 3
    found = capsys.readouterr()
    unused = json.loads(found.out)["unused"]
    assert [(item["what"], item["is_needed"]) for item in unused] == [
        ("/joint_states (1)", True),
        ("/width (1)", False),
    ]
    assert "not used: /joint_states (1): ROS 1 messages are kept and not read" in found.err
    assert Episode.open(run / "episodes" / "a.mcap").topics()["/joint_states"].count == 1


def test_a_ros_1_bag_is_named_with_the_tool_that_converts_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    assert robot_gst.run(["import", "rosbag2", str(tmp_path / "a.bag"), str(tmp_path / "r")]) == 1
    assert "a ROS 1 bag. Convert it: rosbags-convert --src" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        (  # RealSense
            {
                "/camera/camera/color/image_raw": IMAGE,
                "/camera/camera/color/camera_info": INFO,
                "/camera/camera/depth/image_rect_raw": IMAGE,
                "/camera/camera/aligned_depth_to_color/image_raw": IMAGE,
                "/camera/camera/aligned_depth_to_color/camera_info": INFO,
            },
            {
                "/camera/camera/color/image_raw": "/cam/camera_camera/color/image",
                "/camera/camera/color/camera_info": "/cam/camera_camera/color/info",
                "/camera/camera/aligned_depth_to_color/image_raw": "/cam/camera_camera/depth/image",
                "/camera/camera/aligned_depth_to_color/camera_info": (
                    "/cam/camera_camera/depth/info"
                ),
            },
        ),
        (  # ZED
            {
                "/zed/zed_node/rgb/image_rect_color/compressed": JPEG,
                "/zed/zed_node/rgb/camera_info": INFO,
                "/zed/zed_node/depth/depth_registered": IMAGE,
                "/zed/zed_node/depth/camera_info": INFO,
            },
            {
                "/zed/zed_node/rgb/image_rect_color/compressed": "/cam/zed_zed_node/color/image",
                "/zed/zed_node/rgb/camera_info": "/cam/zed_zed_node/color/info",
                "/zed/zed_node/depth/depth_registered": "/cam/zed_zed_node/depth/image",
                "/zed/zed_node/depth/camera_info": "/cam/zed_zed_node/depth/info",
            },
        ),
        (  # Azure, two transports of one image: what was not compressed
            {
                "/rgb/image_raw": IMAGE,
                "/rgb/image_raw/compressed": JPEG,
                "/depth_to_rgb/image_raw": IMAGE,
                "/depth/image_raw": IMAGE,
            },
            {
                "/rgb/image_raw": "/cam/camera/color/image",
                "/depth_to_rgb/image_raw": "/cam/camera/depth/image",
            },
        ),
        ({"/lab/cam/a/color/image": IMAGE, "/x/color/image_raw": IMAGE}, {}),
        ({"/color/image_raw": schema.STRING, "/joint_states": schema.JOINT_STATE}, {}),
    ],
)
def test_topics_of_camera_drivers_get_the_names_that_are_read(
    topics: dict[str, str], expected: dict[str, str]
) -> None:
    assert mapped(topics) == expected


def test_a_topic_is_renamed_on_demand_and_its_bytes_stay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = bag(tmp_path / "a.mcap", [("/front/rgb", JPEG, "cdr", "ros2msg")])
    command = ["import", "rosbag2", str(made), str(tmp_path / "run"), "--remap"]
    assert robot_gst.run([*command, "/front/rgb=/cam/front/color/image"]) == 0
    kept = tmp_path / "run" / "episodes" / "a.mcap"
    for path, topic in ((made, "/front/rgb"), (kept, "/cam/front/color/image")):
        with path.open("rb") as stream:
            (found,) = make_reader(stream).iter_messages()
            assert (found[1].topic, found[2].data) == (topic, b"\0\1\0\0" + bytes(8))
    renamed = Episode.open(kept).metadata_records["source"]["renamed"]
    assert renamed == {"/front/rgb": "/cam/front/color/image"}
    assert robot_gst.run([*command, "/gone=/cam/front/color/image"]) == 2
    assert "It has: /front/rgb" in capsys.readouterr().err


def test_keys_of_posed_images_that_nobody_reads_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.png").write_bytes(encode_png(np.zeros((4, 6, 3), np.uint8)))
    pose = np.eye(4).tolist()
    frame = {"file_path": "images/0.png", "transform_matrix": pose}
    record = {"fl_x": 5.0, "w": 6, "h": 4, "frames": [frame, {**frame, "mask_path": "m.png"}]}
    command = ["import", "images", str(tmp_path), str(tmp_path / "run"), "--metres-per-unit", "1"]
    for code, said in ((0, "mask_path: not read"), (3, "depth_file_path of 2 frames: depth is")):
        (tmp_path / "transforms.json").write_text(json.dumps(record))
        assert robot_gst.run([*command, "--episode", f"scan{code}"]) == code
        assert f"not used: {said}" in capsys.readouterr().err
        record["frames"] = [{**frame, "depth_file_path": "d.png"}] * 2
    (tmp_path / "transforms.json").write_text(json.dumps({**record, "is_fisheye": True}))
    assert robot_gst.run([*command, "--episode", "bent"]) == 2
    assert "frame 1 has is_fisheye" in capsys.readouterr().err


def test_types_without_fields_go_into_a_bag_and_two_types_of_a_topic_stay_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = bag(
        tmp_path / "a.mcap",
        [
            ("/estop", "std_msgs/msg/Empty", "cdr", "ros2msg"),
            ("/a", schema.STRING, "cdr", "ros2msg"),
            ("/a", schema.TF_MESSAGE, "cdr", "ros2msg"),
            ("/a", schema.TF_MESSAGE, "cdr", "ros2msg"),
        ],
    )
    assert robot_gst.run(["export", "rosbag2", str(made), str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["topics"] == {"/a": 3, "/estop": 1}
    assert robot_gst.run(["info", str(made)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["/a", "2", schema.TF_MESSAGE] in lines
    assert ["/a", "1", schema.STRING] in lines
    assert Episode.open(made).topics_of_type(schema.TF_MESSAGE) == ["/a"]
