"""What publishers send that know nothing of us: it is kept, named, and timed as well as can be."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from written_messages import STAMP_NS, raw_image

from bridge.episode import schema
from bridge.episode.cdr.messages import DepthImage
from bridge.episode.check import check_episode
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.record.recorder import Recorder
from bridge.wire.session import WireSample

Make = Callable[..., WireSample]


def image(encoding: str, pixels: np.ndarray, *, big: bool = False) -> bytes:
    data = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).tobytes()
    return raw_image(pixels, encoding, is_bigendian=int(big), data=data)


def recorded(recorder: Recorder, run: RunFolder, samples: list[WireSample]) -> Path:
    recorder.start(EpisodeInfo(id="t1", kind="trial", cell="lab"))
    for sample in samples:
        recorder.receive(sample)
    recorder.stop()
    return run.episodes_dir / "t1.mcap"


def read(path: Path) -> list[tuple[object, ...]]:
    with path.open("rb") as stream:
        return [
            (each, channel, message)
            for each, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
            if channel.topic.startswith("/lab/")
        ]


NOTHING = {"source_ns": None, "sequence": None, "source_gid": None}


@pytest.mark.parametrize(
    ("type_name", "encoding", "data", "expected_ns"),
    [
        (schema.IMAGE, "cdr", image("mono8", np.zeros((2, 2), np.uint8)), STAMP_NS),
        (schema.JOINT_STATE, "cdr", b"\0\1\0\0" + bytes(8 + 4 + 4 + 16), None),  # never set
        (schema.JOINT_STATE, "cdr", b"\0\1\0\0" + struct.pack("<iI", 1, 2**31), None),
        (schema.JOINT_STATE, "cdr", b"\0", None),
        ("std_msgs/msg/String", "cdr", b"\0\1\0\0\1\0\0\0\0", None),
        (
            "geometry_msgs/msg/TwistStamped",
            "cdr",
            b"\0\0\0\0" + struct.pack(">iI", 5, 6),
            5 * 10**9 + 6,
        ),
    ],
)
def test_without_an_attachment_the_message_says_when_it_was_made(
    recorder: Recorder,
    run: RunFolder,
    make_sample: Make,
    type_name: str,
    encoding: str,
    data: bytes,
    expected_ns: int | None,
) -> None:
    sample = make_sample(
        topic="/lab/x", type_name=type_name, message_encoding=encoding, data=data, **NOTHING
    )
    told = make_sample(
        topic="/lab/x", type_name=type_name, message_encoding=encoding, data=data, source_ns=77
    )
    path = recorded(recorder, run, [sample, told])
    (first, second) = [message for _, _, message in read(path)]
    assert first.publish_time == (first.log_time if expected_ns is None else expected_ns)
    assert second.publish_time == 77


@pytest.mark.parametrize("big", [False, True])
def test_depth_in_metres_is_kept_and_read_in_millimetres(
    recorder: Recorder, run: RunFolder, make_sample: Make, big: bool
) -> None:
    metres = np.array([[0.5004, np.nan, np.inf], [-np.inf, 0.0, -1.0], [65.5351, 65.6, 1e30]], "f4")
    data = image("32FC1", metres, big=big)
    topic = "/lab/cam/eye/depth/image"
    path = recorded(recorder, run, [make_sample(topic=topic, type_name=schema.IMAGE, data=data)])
    ((_, channel, message),) = read(path)
    assert message.data == data
    assert channel.metadata == {"image_encoding": "32FC1"}
    depth = DepthImage.from_message(schema.IMAGE, message.data)
    assert depth.depth_mm.tolist() == [[500, 0, 0], [0, 0, 0], [65535, 0, 0]]
    assert depth.stamp_ns == STAMP_NS
    assert check_episode(path).exit_code == 0


def test_another_encoding_of_a_running_camera_is_another_channel(
    recorder: Recorder, run: RunFolder, make_sample: Make
) -> None:
    forms = [
        image("16UC1", np.full((3, 4), 7, np.uint16)),
        image("32FC1", np.full((3, 4), 7, np.float32)),
        image("16UC1", np.full((3, 4), 8, np.uint16)),
    ]
    topic = "/lab/cam/eye/depth/image"
    samples = [make_sample(topic=topic, type_name=schema.IMAGE, data=data) for data in forms]
    found = read(recorded(recorder, run, samples))
    assert [message.data for _, _, message in found] == forms
    ids = [channel.id for _, channel, _ in found]
    assert ids[0] == ids[2] != ids[1]
    names = [channel.metadata["image_encoding"] for _, channel, _ in found]
    assert names == ["16UC1", "32FC1", "16UC1"]
    assert len({each.id for each, _, _ in found}) == 1


def test_a_topic_called_like_a_sensor_may_carry_another_type(
    recorder: Recorder, run: RunFolder, make_sample: Make
) -> None:
    text = b"\0\1\0\0\2\0\0\0x\0"
    named = make_sample(topic="/lab/points", type_name="std_msgs/msg/String", data=text)
    unnamed = make_sample(topic="/lab/base/imu", type_name="", message_encoding="", data=text)
    path = recorded(recorder, run, [named, unnamed])
    kinds = {channel.topic: each and each.name for each, channel, _ in read(path)}
    assert kinds == {"/lab/points": "std_msgs/msg/String", "/lab/base/imu": None}
    assert check_episode(path).faults == []


def test_protobuf_and_json_keep_their_encoding_and_their_name(
    recorder: Recorder, run: RunFolder, make_sample: Make
) -> None:
    forms = {
        "/lab/mic/audio": ("foxglove.RawAudio", "protobuf", b"\x12\x03pcm"),
        "/lab/grasp": ("acme.Grasp", "protobuf", b"\x08\x01"),
        "/lab/note": ("acme/Note", "json", json.dumps({"a": 1}).encode()),
        "/lab/plain": ("", "json", b"{}"),
    }
    path = recorded(
        recorder,
        run,
        [
            make_sample(topic=topic, type_name=name, message_encoding=encoding, data=data)
            for topic, (name, encoding, data) in forms.items()
        ],
    )
    found = {channel.topic: (each, channel, message) for each, channel, message in read(path)}
    for topic, (name, encoding, data) in forms.items():
        each, channel, message = found[topic]
        assert (each.name if each else "", channel.message_encoding) == (name, encoding)
        assert message.data == data
    assert found["/lab/grasp"][0].encoding == ""
