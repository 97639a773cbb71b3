"""The check: losses, rates, times, decoding; and each number of a file that is changed by one."""

import io
import json
import struct
import zlib
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from joint_samples import at_positions
from mcap.writer import CompressionType, Writer

import robot_gst
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import CameraInfo, CompressedColor, DepthImage
from bridge.episode.check import CheckReport, check_episode
from bridge.episode.check_topics import missing_numbers
from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.format import MAGIC, RECORD_HEAD
from bridge.episode.mcap.walk import RecordSpan, walk
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.topics import DROPS
from bridge.episode.writer import EpisodeWriter
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg, encode_png

JOINTS = "/c/joint_states"
DEPTH = "/c/cam/side/depth/image"
INFO = EpisodeInfo(id="e1", kind="trial")


def joint() -> bytes:
    return at_positions(0, ("a",), np.zeros(1)).to_cdr()


def depth(width: int, height: int) -> bytes:
    depth_mm = np.zeros((height, width), dtype=np.uint16)
    return DepthImage(stamp_ns=0, frame_id="", depth_mm=depth_mm).to_cdr()


def drops(topic: str, **counts: int) -> dict[str, Any]:
    empty = {"received": 0, "gaps": 0, "queue_drops": 0, "bytes": 0}
    return {"schema_version": 1, "topic": topic, "second": 0, **empty, **counts}


def check(folder: Path, fill: Callable[[EpisodeWriter], None], info: Any = INFO) -> CheckReport:
    path = folder / "e1.mcap"
    with EpisodeWriter(path) as writer:
        if info is not None:
            writer.describe(info)
        fill(writer)
    return check_episode(path)


def write_joints(writer: EpisodeWriter, sequences: list[int] | range, step_ns: int = 1) -> None:
    for number, sequence in enumerate(sequences):
        writer.write(
            JOINTS,
            joint(),
            type_name=schema.JOINT_STATE,
            log_time_ns=1000 + number * step_ns,
            publish_time_ns=990,
            sequence=sequence,
        )


def gaps(sequences: list[int]) -> int:
    return missing_numbers(array("L", sequences))


@given(st.integers(0, 2**32 - 1), st.sets(st.integers(1, 60)), st.randoms())
def test_missing_numbers_are_counted_over_the_wrap_and_in_any_near_order(
    start: int, lost: set[int], random: Any
) -> None:
    kept = [n for n in range(62) if n not in lost]
    assert gaps([(start + n) % 2**32 for n in kept]) == len(lost)
    shuffled = list(kept)
    for n in range(1, len(kept) - 2, 3):  # neighbours change places; the first number stays
        if random.random() < 0.5:
            shuffled[n : n + 2] = reversed(shuffled[n : n + 2])
    assert gaps([(start + n) % 2**32 for n in shuffled]) == len(lost)


def test_a_publisher_that_begins_anew_is_no_gap_but_its_losses_are() -> None:
    assert gaps([100, 101, 0, 1, 2, 4]) == 1


def test_losses_the_ledger_lists_are_declared(tmp_path: Path) -> None:
    def fill(writer: EpisodeWriter) -> None:
        write_joints(writer, [0, 1, 5, 6, 9])
        record = drops(JOINTS, gaps=2, queue_drops=2, shed=1)
        writer.write(DROPS, record, type_name=schema.DROPS, log_time_ns=2000)

    report = check(tmp_path, fill)
    assert (report.exit_code, report.summary) == (3, "drops logged")
    assert (report.declared_losses, report.undeclared_losses) == (5, 0)
    assert report.topics[JOINTS].sequence_gaps == 5
    assert report.topics[JOINTS].declared_losses == 5


def test_losses_the_ledger_does_not_list_are_named(tmp_path: Path) -> None:
    def fill(writer: EpisodeWriter) -> None:
        write_joints(writer, [0, 1, 5])
        writer.write(DROPS, drops(JOINTS, gaps=1), type_name=schema.DROPS, log_time_ns=2000)

    report = check(tmp_path, fill)
    assert (report.exit_code, report.summary) == (3, "drops not logged")
    assert (report.declared_losses, report.undeclared_losses) == (1, 2)
    assert report.findings[0].text == "3 numbers are missing, the drop log lists 1"


def test_without_a_ledger_numbers_prove_nothing(tmp_path: Path) -> None:
    report = check(tmp_path, lambda writer: write_joints(writer, [0, 7]))
    assert report.exit_code == 0
    assert report.topics[JOINTS].sequence_gaps == 6


def test_rates_are_reported(tmp_path: Path) -> None:
    report = check(tmp_path, lambda writer: write_joints(writer, range(11), step_ns=10_000_000))
    assert report.topics[JOINTS].rate_hz == pytest.approx(100)
    assert report.exit_code == 0


@pytest.mark.parametrize("kind", ["raw depth", "JPEG", "PNG", "raw colour"])
def test_images_that_do_not_fit_their_camera_are_found(tmp_path: Path, kind: str) -> None:
    rgb = np.zeros((6, 8, 3), np.uint8)
    stored = encode_png(rgb) if kind == "PNG" else encode_jpeg(rgb)
    packed = CompressedColor(stamp_ns=0, frame_id="", format="", data=stored).to_cdr()
    about = {"height": 6, "width": 8, "step": 24, "encoding": "rgb8", "data": rgb.tobytes()}
    of_type = schema.COMPRESSED_IMAGE if kind in ("JPEG", "PNG") else schema.IMAGE
    topic = DEPTH if "depth" in kind else DEPTH.replace("depth", "color")
    images = {"raw depth": depth(8, 6), "raw colour": codec.encode(schema.IMAGE, about)}

    def fill(writer: EpisodeWriter) -> None:
        camera = Camera.from_ros(width=9, height=6, fx=5.0, fy=5.0, cx=4.0, cy=3.0)
        data = CameraInfo(stamp_ns=0, frame_id="", camera=camera).to_cdr()
        info = topic.replace("image", "info")
        writer.write(info, data, type_name=schema.CAMERA_INFO, log_time_ns=1)
        writer.write(topic, images.get(kind, packed), type_name=of_type, log_time_ns=2)

    assert "images of 8 x 6, its camera info says 9 x 6" in check(tmp_path, fill).faults[0]


def foreign(path: Path, topic: str, name: str, data: bytes) -> Path:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="ros2", library="libmcap 1.1.0")
    known = schema.schema_for(name)
    assert known is not None
    schema_id = writer.register_schema(name=name, encoding="ros2msg", data=known.data)
    channel = writer.register_channel(topic, known.message_encoding, schema_id)
    for log_ns in (5, 3):
        writer.add_message(channel, log_ns, data, log_ns, sequence=7)
    writer.finish()
    path.write_bytes(stream.getvalue())
    return path


def test_our_contract_is_not_asked_of_other_programs(tmp_path: Path) -> None:
    report = check_episode(foreign(tmp_path / "x.mcap", JOINTS, schema.JOINT_STATE, b"no CDR"))
    assert (report.exit_code, report.summary, report.faults) == (3, "unreadable", [])
    assert report.topics[JOINTS].undecodable == 2
    assert report.findings[0].text.startswith("2 of 2 messages cannot be read: not a valid")


def test_the_command_prints_everything_as_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fill(writer: EpisodeWriter) -> None:
        write_joints(writer, [0, 2])
        writer.write(DROPS, drops(JOINTS, gaps=1), type_name=schema.DROPS, log_time_ns=2000)

    check(tmp_path, fill)
    part = tmp_path / "e2.mcap.part"
    part.write_bytes(b"")
    assert robot_gst.run(["check", str(tmp_path), "--json"]) == 3
    said = capsys.readouterr()
    assert f"robot-gst recover {part}" in said.err
    data = json.loads(said.out)
    assert data["unfinished"] == [str(part)]
    (episode,) = data["episodes"]
    assert episode["state"] == "drops logged"
    assert episode["topics"][JOINTS]["sequence_gaps"] == 1
    assert episode["topics"][JOINTS]["messages"] == 2


def test_an_unfinished_file_named_alone_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = tmp_path / "e2.mcap.part"
    part.write_bytes(b"")
    assert robot_gst.run(["check", str(part)]) == 1
    assert "robot-gst recover" in capsys.readouterr().err


FOOTER_CRC_BYTES = 4 + len(MAGIC)


def whole_file() -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=60, compression=CompressionType.NONE, enable_data_crcs=True)
    writer.start(profile="", library="another program")
    schema_id = writer.register_schema(name="kind", encoding="enc", data=b"schema")
    channels = [writer.register_channel(topic, "raw", schema_id) for topic in ("/a", "/b")]
    # Chunks overlap in time, and within each the messages are not in order.
    for number, log_ns in enumerate((50, 10, 30, 20, 60, 40)):
        writer.add_message(channels[number % 2], log_ns, b"payload", log_ns, sequence=number)
    writer.add_attachment(1, 2, "name", "text/plain", b"attached")
    writer.add_metadata("about", {"key": "value"})
    writer.finish()
    return stream.getvalue()


def places(data: bytes) -> list[RecordSpan]:
    return list(walk(io.BytesIO(data), len(MAGIC), len(data) - len(MAGIC)))


def find(data: bytes, opcode: int, *, in_summary: bool) -> RecordSpan:
    end = next(place for place in places(data) if place.opcode == mcap_format.DATA_END)
    return next(
        place
        for place in places(data)
        if place.opcode == opcode and (place.offset > end.offset) == in_summary
    )


def with_right_crcs(data: bytearray) -> bytearray:
    """State the CRCs of data section and summary anew, so that only the change is wrong."""
    end = find(bytes(data), mcap_format.DATA_END, in_summary=False)
    struct.pack_into("<I", data, end.offset + 9, zlib.crc32(data[: end.offset]))
    section = bytes(data[end.end : -FOOTER_CRC_BYTES])
    struct.pack_into("<I", data, len(data) - FOOTER_CRC_BYTES, zlib.crc32(section))
    return data


def faults_in(path: Path, data: bytes) -> list[str]:
    path.write_bytes(data)
    report = check_episode(path)
    assert report.exit_code == (1 if report.faults else 0)
    return report.faults


def test_the_untouched_file_is_clean(tmp_path: Path) -> None:
    data = whole_file()
    assert with_right_crcs(bytearray(data)) == data
    assert faults_in(tmp_path / "x.mcap", data) == []


STATEMENTS = [
    (mcap_format.CHUNK, False, 0, "says its messages are from"),
    (mcap_format.CHUNK, False, 8, "says its messages are from"),
    (mcap_format.CHUNK, False, 16, "are declared"),
    (mcap_format.CHUNK, False, 24, "another CRC"),
    (mcap_format.MESSAGE_INDEX, False, 0, "does not point at the messages"),
    (mcap_format.MESSAGE_INDEX, False, 6, "does not point at the messages"),
    (mcap_format.MESSAGE_INDEX, False, 14, "does not point at the messages"),
    (mcap_format.ATTACHMENT, False, -1, "attachment 'name' has another CRC"),
    (mcap_format.ATTACHMENT, False, -5, "attachment 'name' has another CRC"),
    (mcap_format.STATISTICS, True, 0, "messages, 6 were read"),
    (mcap_format.STATISTICS, True, 8, "schemas, 1 were read"),
    (mcap_format.STATISTICS, True, 10, "channels, 2 were read"),
    (mcap_format.STATISTICS, True, 14, "attachments, 1 were read"),
    (mcap_format.STATISTICS, True, 18, "metadata records, 1 were read"),
    (mcap_format.STATISTICS, True, 22, "chunks, "),
    (mcap_format.STATISTICS, True, 26, "the summary says messages from"),
    (mcap_format.STATISTICS, True, 34, "the summary says messages from"),
    (mcap_format.STATISTICS, True, 48, "/a: the summary says 2 messages, 3 were read"),
    (mcap_format.CHUNK_INDEX, True, 0, "wrong about message_start_time"),
    (mcap_format.CHUNK_INDEX, True, 8, "wrong about message_end_time"),
    (mcap_format.CHUNK_INDEX, True, 16, "where none lies"),
    (mcap_format.CHUNK_INDEX, True, 24, "wrong about chunk_length"),
    (mcap_format.CHUNK_INDEX, True, 38, "wrong about message_index_offsets"),
    (mcap_format.CHUNK_INDEX, True, -1, "wrong about uncompressed_size"),
    (mcap_format.CHUNK_INDEX, True, -9, "wrong about compressed_size"),
    (mcap_format.ATTACHMENT_INDEX, True, 0, "where none lies"),
    (mcap_format.ATTACHMENT_INDEX, True, 8, "wrong about length"),
    (mcap_format.ATTACHMENT_INDEX, True, 16, "wrong about log_time"),
    (mcap_format.ATTACHMENT_INDEX, True, 24, "wrong about create_time"),
    (mcap_format.ATTACHMENT_INDEX, True, 32, "wrong about data_size"),
    (mcap_format.ATTACHMENT_INDEX, True, 44, "wrong about name"),
    (mcap_format.METADATA_INDEX, True, 0, "where none lies"),
    (mcap_format.METADATA_INDEX, True, 8, "wrong about length"),
    (mcap_format.METADATA_INDEX, True, 20, "wrong about name"),
    (mcap_format.SCHEMA, True, 6, "the summary's schema 1"),
    (mcap_format.CHANNEL, True, 8, "the summary's channel 1"),
]


@pytest.mark.parametrize(("opcode", "in_summary", "at", "expected"), STATEMENTS)
def test_a_number_that_is_off_by_one_is_found(
    tmp_path: Path, opcode: int, in_summary: bool, at: int, expected: str
) -> None:
    data = bytearray(whole_file())
    place = find(bytes(data), opcode, in_summary=in_summary)
    position = place.offset + RECORD_HEAD.size + at if at >= 0 else place.end + at
    data[position] ^= 1
    faults = faults_in(tmp_path / "x.mcap", bytes(with_right_crcs(data)))
    assert any(expected in fault for fault in faults), faults
    assert all("x.mcap" in fault for fault in faults)


@pytest.mark.parametrize("opcode", [mcap_format.DATA_END, mcap_format.FOOTER])
def test_a_wrong_crc_of_data_or_summary_is_found(tmp_path: Path, opcode: int) -> None:
    data = bytearray(whole_file())
    data[find(bytes(data), opcode, in_summary=opcode == mcap_format.FOOTER).end - 1] ^= 1
    faults = faults_in(tmp_path / "x.mcap", bytes(data))
    assert "another CRC than it declares" in faults[0]


def test_every_flipped_bit_is_found(tmp_path: Path) -> None:
    data = whole_file()
    found = 0
    positions = range(0, len(data) * 8, 101)
    for bit in positions:
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        found += bool(faults_in(tmp_path / "x.mcap", bytes(changed)))
    assert found == len(positions)


def test_every_cut_is_found(tmp_path: Path) -> None:
    data = whole_file()
    for length in range(0, len(data), 37):
        assert faults_in(tmp_path / "x.mcap", data[:length])
