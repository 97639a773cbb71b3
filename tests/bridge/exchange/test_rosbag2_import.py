"""A bag becomes an episode, no byte of a message changed; imports name what they do not use."""

import io
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

import robot_gst
from bridge.episode import schema
from bridge.episode.check import check_episode
from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.schema import ROS_TYPES, schema_text
from bridge.episode.streams import recorded_robot
from bridge.errors import BridgeError, EpisodeError, PathNotFoundError, UsageError
from bridge.exchange.driver_names import mapped
from bridge.exchange.rosbag2 import find_files, import_bag
from bridge.media.color import encode_png

DATA = Path(os.environ.get("GST_SHARED_DATA", Path(__file__).resolve().parents[4] / "shared/data"))
BAGS = sorted((DATA / "mcap_foreign_rosbag2").glob("*.mcap"))


def head_of(channel: Channel, schema: Schema | None) -> tuple[object, ...]:
    kind = None if schema is None else (schema.name, schema.encoding, schema.data)
    return channel.topic, channel.message_encoding, kind


def contents(path: Path) -> list[tuple[object, ...]]:
    """Everything about every message, by the official reader."""
    with path.open("rb") as stream:
        return [
            (*head_of(c, s), m.log_time, m.publish_time, m.sequence, m.data)
            for s, c, m in make_reader(stream, validate_crcs=True).iter_messages()
        ]


def bag(path: Path, times: range, *, schema: bytes = b"string data\n") -> Path:
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD, chunk_size=200)
    writer.start(profile="ros2", library="libmcap 1.1.0")
    schema_id = writer.register_schema("std_msgs/msg/String", "ros2msg", schema)
    topic = writer.register_channel("/a", "cdr", schema_id, {"offered_qos_profiles": "- depth: 1"})
    bare = writer.register_channel("no slash", "json", 0)
    writer.register_channel("/silent", "cdr", schema_id)
    for n in times:
        data = b"\0\1\0\0" + n.to_bytes(4, "big")
        writer.add_message(topic, n * 10, data, n * 9, sequence=n * 7)
        writer.add_message(bare, n * 10, b"{}", n * 10, sequence=0)
    writer.add_attachment(1, 2, "notes.txt", "text/plain", b"notes")
    writer.add_metadata("rosbag2", {"serialized_metadata": "version: 8"})
    writer.add_metadata("episode", {"id": "of another program"})
    writer.finish()
    path.write_bytes(stream.getvalue())
    return path


def test_the_robot_that_is_named_counts_more_than_a_recorded_one(
    make_trial: Callable[..., Path], tmp_path: Path
) -> None:
    trial = make_trial(kind="imported")
    assert recorded_robot(Episode.open(trial)).name == "ur5_parallel_gripper"
    words = ["import", "rosbag2", str(trial), str(tmp_path / "run"), "--episode", "e"]
    assert robot_gst.run([*words, "--robot", "xarm7_parallel_gripper"]) == 0
    episode = Episode.open(tmp_path / "run" / "episodes" / "e.mcap")
    assert recorded_robot(episode).name == "xarm7_parallel_gripper"
    assert robot_gst.run([*words[:-1], "f", "--robot", "nobodys"]) == 2
    assert not (tmp_path / "run" / "episodes" / "f.mcap").exists()


def folder_bag(folder: Path, *names: str, extra: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    listed = "".join(f"    - {name}\n" for name in names)
    text = f"rosbag2_bagfile_information:\n  version: 8\n  storage_identifier: mcap\n{extra}"
    (folder / "metadata.yaml").write_text(text + f"  relative_file_paths:\n{listed}")
    return folder


def imported(source: Path, folder: Path) -> Path:
    return import_bag(source, RunFolder.create(folder / "run"), episode_id="b").path


@pytest.mark.parametrize("path", BAGS, ids=lambda path: path.stem)
def test_bags_of_other_programs_come_through_byte_for_byte(path: Path, tmp_path: Path) -> None:
    made = imported(path, tmp_path)
    assert contents(made) == contents(path)
    report = check_episode(made)
    assert (report.exit_code, report.faults) == (0, [])
    episode = Episode.open(made)
    assert episode.info.kind == "imported"
    (source,) = episode.metadata_records["source"]["files"]
    assert (source["name"], source["sha256"]) == (path.name, hash_file(path))


def test_everything_beside_the_messages_is_kept_too(tmp_path: Path) -> None:
    made = imported(bag(tmp_path / "x_0.mcap", range(9)), tmp_path)
    episode = Episode.open(made)
    records = episode.metadata_records
    assert records["rosbag2"] == {"serialized_metadata": "version: 8"}
    assert records["source.episode"] == {"id": "of another program"}
    assert records["source"]["silent_topics"] == ["/silent"]
    assert records["source"]["channels"] == {"/a": {"offered_qos_profiles": "- depth: 1"}}
    assert episode.attachment("notes.txt") == b"notes"
    assert episode.info.id == "b"


def test_a_bag_of_several_files_is_one_episode_in_log_order(tmp_path: Path) -> None:
    folder = folder_bag(tmp_path / "bag", "x_0.mcap", '"x_1.mcap"')
    parts = [bag(folder / "x_0.mcap", range(9)), bag(folder / "x_1.mcap", range(5, 14))]
    found = contents(imported(folder, tmp_path))
    expected = [item for part in parts for item in contents(part)]
    assert found == sorted(expected, key=lambda item: item[3])
    assert len(found) == 36


def test_a_schema_that_changes_between_files_is_kept_in_both_forms(tmp_path: Path) -> None:
    folder = folder_bag(tmp_path / "bag", "x_0.mcap", "x_1.mcap")
    bag(folder / "x_0.mcap", range(2))
    bag(folder / "x_1.mcap", range(2, 4), schema=b"string data # new\n")
    texts = {item[2][2] for item in contents(imported(folder, tmp_path)) if item[2]}
    assert texts == {b"string data\n", b"string data # new\n"}


def test_a_folder_without_metadata_is_all_its_files(tmp_path: Path) -> None:
    paths = [bag(tmp_path / f"x_{n}.mcap", range(n, n + 2)) for n in (1, 0)]
    assert find_files(tmp_path) == sorted(paths)


@pytest.mark.parametrize(
    ("extra", "names", "error", "found"),
    [
        ("", ("gone.mcap",), PathNotFoundError, "gone.mcap"),
        ("", ("../outside.mcap",), BridgeError, "lies outside its folder"),
        (
            "  compression_mode: FILE\n  compression_format: lz4\n",
            ("x",),
            BridgeError,
            "zstd is read",
        ),
        ("  broken: [\n", ("x.mcap",), BridgeError, "it is no YAML"),
        ("  relative_file_paths: 3\n", (), BridgeError, "it is no YAML|lists no files"),
    ],
)
def test_a_bag_that_cannot_be_read_is_one_sentence(
    tmp_path: Path, extra: str, names: tuple[str, ...], error: type[Exception], found: str
) -> None:
    bag(tmp_path / "outside.mcap", range(2))
    folder = folder_bag(tmp_path / "bag", *names, extra=extra)
    with pytest.raises(error, match=found):
        import_bag(folder, RunFolder.create(tmp_path / "run"), episode_id="b")
    assert list((tmp_path / "run" / "episodes").iterdir()) == []


def test_another_storage_is_refused(tmp_path: Path) -> None:
    folder = folder_bag(tmp_path / "bag", "x.db3")
    about = folder / "metadata.yaml"
    about.write_text(about.read_text().replace(": mcap", ": leveldb"))
    with pytest.raises(BridgeError, match="its storage is 'leveldb'; mcap and sqlite3 are read"):
        find_files(folder)


@pytest.mark.parametrize("keep", [0.5, 0.9])
def test_an_unfinished_or_damaged_bag_leaves_no_episode(tmp_path: Path, keep: float) -> None:
    path = bag(tmp_path / "x.mcap", range(40))
    data = bytearray(path.read_bytes())
    data[int(len(data) * 0.2)] ^= 1
    path.write_bytes(data if keep > 0.5 else data[: len(data) // 2])
    with pytest.raises(EpisodeError, match=r"x\.mcap"):
        imported(path, tmp_path)
    assert list((tmp_path / "run" / "episodes").iterdir()) == []


def test_the_command_imports_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bag(tmp_path / "rosbag2 2024.05.01_0.mcap", range(3))
    command = ["import", "rosbag2", str(path), str(tmp_path / "run"), "--json"]
    assert robot_gst.run(command) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["messages"] == 6
    assert Path(data["file"]).name == "rosbag2_2024_05_01_0.mcap"
    with pytest.raises(UsageError, match="exists already"):
        import_bag(path, RunFolder(tmp_path / "run"), episode_id="rosbag2_2024_05_01_0")
    assert robot_gst.run(command) == 2


IMAGE, INFO = schema.IMAGE, schema.CAMERA_INFO
JPEG = schema.COMPRESSED_IMAGE


def bag_of(path: Path, channels: list[tuple[str, str, str, str]]) -> Path:
    """One message on each channel: topic, type, encoding of its messages and of its definition."""
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    for number, (topic, name, encoding, text) in enumerate(channels):
        known = schema_text(name) if name in ROS_TYPES else ""
        definition = known if text == "ros2msg" else "float64 data"
        kind = writer.register_schema(name, text, definition.encode())
        channel = writer.register_channel(topic, encoding, kind)
        writer.add_message(channel, number, b"\0\1\0\0" + bytes(8), number)
    writer.finish()
    path.write_bytes(stream.getvalue())
    return path


def test_messages_of_ros_1_are_kept_and_said_not_to_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = bag_of(
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
    made = bag_of(tmp_path / "a.mcap", [("/front/rgb", JPEG, "cdr", "ros2msg")])
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


def test_keys_of_transforms_that_nobody_reads_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.png").write_bytes(encode_png(np.zeros((4, 6, 3), np.uint8)))
    pose = np.eye(4).tolist()
    (tmp_path / "0.png").write_bytes(encode_png(np.full((4, 6), 900, np.uint16)))
    frame = {"file_path": "images/0.png", "transform_matrix": pose, "depth_file_path": "0.png"}
    record = {"fl_x": 5.0, "w": 6, "h": 4, "frames": [frame, {**frame, "mask_path": "m.png"}]}
    command = ["import", "rgbd", str(tmp_path), str(tmp_path / "run")]
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    assert robot_gst.run([*command, "--episode", "scan0"]) == 0
    assert "not used: mask_path: not read" in capsys.readouterr().err
    (tmp_path / "transforms.json").write_text(json.dumps({**record, "is_fisheye": True}))
    assert robot_gst.run([*command, "--episode", "bent"]) == 2
    assert "frame 1 has is_fisheye" in capsys.readouterr().err


def test_types_without_fields_go_into_a_bag_and_two_types_of_a_topic_stay_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = bag_of(
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
