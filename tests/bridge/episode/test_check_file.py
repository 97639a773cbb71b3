"""Every number a file states of itself is changed by one: the check must find it."""

import io
import struct
import zlib
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from bridge.episode.check import check_episode
from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.format import MAGIC, RECORD_HEAD
from bridge.episode.mcap.walk import RecordSpan, walk

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


def check(path: Path, data: bytes) -> list[str]:
    path.write_bytes(data)
    report = check_episode(path)
    assert report.exit_code == (1 if report.faults else 0)
    return report.faults


def test_the_untouched_file_is_clean(tmp_path: Path) -> None:
    data = whole_file()
    assert with_right_crcs(bytearray(data)) == data
    assert check(tmp_path / "x.mcap", data) == []


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
    (mcap_format.SUMMARY_OFFSET, True, 0, "the summary's offset"),
    (mcap_format.SUMMARY_OFFSET, True, 1, "the summary's offset"),
]


@pytest.mark.parametrize(("opcode", "in_summary", "at", "expected"), STATEMENTS)
def test_a_number_that_is_off_by_one_is_found(
    tmp_path: Path, opcode: int, in_summary: bool, at: int, expected: str
) -> None:
    data = bytearray(whole_file())
    place = find(bytes(data), opcode, in_summary=in_summary)
    position = place.offset + RECORD_HEAD.size + at if at >= 0 else place.end + at
    data[position] ^= 1
    faults = check(tmp_path / "x.mcap", bytes(with_right_crcs(data)))
    assert any(expected in fault for fault in faults), faults
    assert all("x.mcap" in fault for fault in faults)


@pytest.mark.parametrize("opcode", [mcap_format.DATA_END, mcap_format.FOOTER])
def test_a_wrong_crc_of_data_or_summary_is_found(tmp_path: Path, opcode: int) -> None:
    data = bytearray(whole_file())
    data[find(bytes(data), opcode, in_summary=opcode == mcap_format.FOOTER).end - 1] ^= 1
    faults = check(tmp_path / "x.mcap", bytes(data))
    assert "another CRC than it declares" in faults[0]


def test_every_flipped_bit_is_found(tmp_path: Path) -> None:
    data = whole_file()
    found = 0
    positions = range(0, len(data) * 8, 101)
    for bit in positions:
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        found += bool(check(tmp_path / "x.mcap", bytes(changed)))
    assert found == len(positions)


def test_every_cut_is_found(tmp_path: Path) -> None:
    data = whole_file()
    for length in range(0, len(data), 37):
        assert check(tmp_path / "x.mcap", data[:length])
