"""Bags against rosbags, an independent implementation: each reads what the other writes."""

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from joint_samples import at_positions
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import robot_gst
from bridge.episode import schema
from bridge.episode.cdr.messages import DepthImage, string_to_cdr
from bridge.episode.check import check_episode
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.schema import Schema
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError, UsageError
from bridge.exchange.rosbag2 import import_bag
from bridge.exchange.rosbag2_export import export_bag
from bridge.exchange.rosbag2_storage import SqliteBag

STORE = get_typestore(Stores.ROS2_JAZZY)
STRING, IMU = "std_msgs/msg/String", "sensor_msgs/msg/Imu"
START_NS = 1_700_000_000_000_000_000
Message = tuple[str, str, int, bytes]


def imu_cdr(number: int) -> bytes:
    t = STORE.types
    vector = t["geometry_msgs/msg/Vector3"]
    message = t[IMU](
        t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](number, 5), "imu"),
        t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        np.zeros(9),
        vector(1.0, 2.0, float(number)),
        np.zeros(9),
        vector(0.0, 0.0, 9.81),
        np.zeros(9),
    )
    return bytes(STORE.serialize_cdr(message, IMU))


def write_bag(path: Path, plugin: StoragePlugin, mode: CompressionMode) -> list[Message]:
    """A bag by rosbags with two topics; returns what it holds in the order of time."""
    written: list[Message] = []
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        text = writer.add_connection("/chatter", STRING, typestore=STORE)
        imu = writer.add_connection("/lab/imu", IMU, typestore=STORE)
        for number in range(50):
            at_ns = START_NS + number * 1000
            for connection, data in (
                (text, string_to_cdr("text " * number)),
                (imu, imu_cdr(number)),
            ):
                writer.write(connection, at_ns, data)
                written.append((connection.topic, connection.msgtype, at_ns, data))
    return written


def stored(path: Path) -> list[Message]:
    return [
        (each.topic, each.type_name, each.log_time_ns, each.data)
        for each in Episode.open(path).messages()
    ]


def by_time(messages: list[Message]) -> list[Message]:
    """Messages of one instant lie in the order of their chunks, which is nobody's promise."""
    return sorted(messages, key=lambda each: (each[2], each[0]))


def imported(source: Path, folder: Path) -> Path:
    return import_bag(source, RunFolder.create(folder / "run"), episode_id="b").path


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize(
    "mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE]
)
def test_every_bag_that_rosbags_writes_is_imported_as_it_was(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    expected = write_bag(tmp_path / "bag", plugin, mode)
    made = imported(tmp_path / "bag", tmp_path)
    assert sorted(stored(made), key=lambda each: each[2]) == expected
    report = check_episode(made)
    assert (report.exit_code, report.faults) == (0, [])
    with made.open("rb") as stream:
        kinds = {
            (each.name, each.encoding): each.data.decode()
            for each, _, _ in make_reader(stream).iter_messages()
            if each is not None
        }
    assert set(kinds) == {(STRING, "ros2msg"), (IMU, "ros2msg")}
    assert "string data" in kinds[STRING, "ros2msg"]
    assert [path.name for path in (tmp_path / "run").glob("rosbag2_*")] == []


def test_damaged_compression_and_databases_leave_no_episode(tmp_path: Path) -> None:
    write_bag(tmp_path / "a", StoragePlugin.MCAP, CompressionMode.FILE)
    (packed,) = (tmp_path / "a").glob("*.zstd")
    data = bytearray(packed.read_bytes())
    packed.write_bytes(data[: len(data) // 2])
    write_bag(tmp_path / "b", StoragePlugin.SQLITE3, CompressionMode.NONE)
    (database,) = (tmp_path / "b").glob("*.db3")
    data = bytearray(database.read_bytes())
    data[4096 : len(data)] = b"\xff" * (len(data) - 4096)
    database.write_bytes(data)
    (tmp_path / "c.db3").write_bytes(b"SQLite format 3\0" + b"junk" * 100)
    with sqlite3.connect(tmp_path / "d.db3") as empty:
        empty.execute("CREATE TABLE other (id INTEGER)")
    empty.close()
    for source in (tmp_path / "a", tmp_path / "b", tmp_path / "c.db3", tmp_path / "d.db3"):
        with pytest.raises(EpisodeError):
            imported(source, tmp_path)
    assert list((tmp_path / "run" / "episodes").iterdir()) == []


def test_an_old_database_takes_its_definitions_from_what_is_known(tmp_path: Path) -> None:
    database = sqlite3.connect(tmp_path / "old.db3")
    database.execute(
        "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format)"
    )
    database.execute(
        "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)"
    )
    database.execute("INSERT INTO topics VALUES (3, '/a', ?, 'cdr')", (STRING,))
    database.execute("INSERT INTO topics VALUES (4, '/b', 'my_msgs/msg/Grip', 'cdr')")
    for number, topic in enumerate((3, 4, 3)):
        row = (topic, START_NS - number, string_to_cdr(str(number)))
        database.execute("INSERT INTO messages VALUES (NULL, ?, ?, ?)", row)
    database.commit()
    database.close()
    found = SqliteBag(tmp_path / "old.db3")
    assert [each.record.schema_encoding for each in found.topics.values()] == ["ros2msg", ""]
    assert [each.log_time_ns for each in found.messages()] == [START_NS - n for n in (2, 1, 0)]
    found.close()


def write_episode(path: Path) -> list[Message]:
    """Everything an episode may hold; returns what rosbag2 can take."""
    kept: list[Message] = []
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial", cell="lab"))
        writer.attach("robot.urdf", b"<robot/>", media_type="text/xml", log_time_ns=1)
        for number in range(30):
            at_ns = START_NS + number * 1_000_000
            joints = at_positions(at_ns, ("a",), np.array([float(number)]))
            pixels = np.full((4, 5), number, np.uint16)
            image = DepthImage(stamp_ns=at_ns, frame_id="eye", depth_mm=pixels)
            messages = [
                ("/lab/joint_states", schema.JOINT_STATE, joints.to_cdr()),
                ("/lab/cam/eye/depth/image", schema.IMAGE, image.to_cdr()),
            ]
            if number == 0:
                messages.append(("/robot_description", schema.STRING, string_to_cdr("<robot/>")))
            for topic, kind, data in messages:
                writer.write(
                    topic,
                    data,
                    type_name=kind,
                    log_time_ns=at_ns,
                    publish_time_ns=at_ns - 7,
                    sequence=number * 2,
                )
                kept.append((topic, kind, at_ns, data))
            event = {"schema_version": 1, "stamp_ns": at_ns, "type": "mark", "text": "größer"}
            writer.write("/lab/event", event, type_name=schema.EVENT, log_time_ns=at_ns)
            truth = "/standin/truth/object/x/pose"
            writer.write(truth, b"\0\1\0\0", schema_record=None, log_time_ns=at_ns)
            writer.write("/lab/raw", b"raw", schema_record=None, log_time_ns=at_ns)
            nameless = Schema(
                name="my_msgs/msg/Grip", schema_encoding="", message_encoding="cdr", data=b""
            )
            writer.write("/lab/grip", b"\0\1\0\0", schema_record=nameless, log_time_ns=at_ns)
    return kept


def any_reader(folder: Path) -> tuple[list[Message], dict[str, Any], list[Any]]:
    """What rosbags reads: messages, connections by topic, and all of it decoded."""
    with AnyReader([folder]) as reader:
        messages, decoded = [], []
        for connection, stamp_ns, data in reader.messages():
            messages.append((connection.topic, connection.msgtype, stamp_ns, bytes(data)))
            decoded.append(reader.deserialize(data, connection.msgtype))
        return messages, {each.topic: each for each in reader.connections}, decoded


def test_rosbags_reads_every_topic_of_an_export(tmp_path: Path) -> None:
    kept = write_episode(tmp_path / "t1.mcap")
    report = export_bag(Episode.open(tmp_path / "t1.mcap"), tmp_path / "bag")
    assert report.left_out == {
        "/lab/event": "json, not ROS 2",
        "/lab/raw": "bytes, not ROS 2",
        "/lab/grip": "no definition of my_msgs/msg/Grip",
    }
    messages, connections, decoded = any_reader(tmp_path / "bag")
    assert by_time(messages) == by_time(kept)
    positions = [each.position[0] for each in decoded if hasattr(each, "position")]
    assert positions == [float(number) for number in range(30)]
    assert {topic: each.msgcount for topic, each in connections.items()} == report.topics
    (qos,) = connections["/robot_description"].ext.offered_qos_profiles
    assert (qos.durability, qos.depth) == (QosDurability.TRANSIENT_LOCAL, 1)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        found = list(make_reader(stream, validate_crcs=True).iter_messages())
    official = [(c.topic, s.name, m.log_time, m.data) for s, c, m in found if s]
    assert by_time(official) == by_time(kept)
    numbers = [m.sequence for _, c, m in found if c.topic == "/lab/joint_states"]
    assert numbers == list(range(0, 60, 2))
    assert {m.log_time - m.publish_time for _, _, m in found} == {7}


def test_an_export_lists_what_it_leaves_out_and_replaces_only_when_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_episode(tmp_path / "t1.mcap")
    command = ["export", "rosbag2", str(tmp_path / "t1.mcap"), str(tmp_path / "bag")]
    assert robot_gst.run(command) == 0
    assert "left out: /lab/grip (no definition of my_msgs/msg/Grip)" in capsys.readouterr().out
    assert robot_gst.run(command) == 2  # it is there already
    assert robot_gst.run([*command, "--force"]) == 0


def test_an_episode_without_ros_messages_is_no_bag(tmp_path: Path) -> None:
    with EpisodeWriter(tmp_path / "t1.mcap") as writer:
        writer.write("/raw", b"x", schema_record=None, log_time_ns=1)
    with pytest.raises(UsageError, match="holds no ROS 2 messages"):
        export_bag(Episode.open(tmp_path / "t1.mcap"), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()
