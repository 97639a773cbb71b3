"""The conformance files of the MCAP project, record by record, and bags other programs wrote."""

import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import McapRecord

from bridge.episode.check import check_episode
from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.file import McapFile
from bridge.episode.mcap.format import MAGIC, MESSAGE, MESSAGE_HEAD, RECORD_HEAD
from bridge.episode.mcap.walk import (
    attachment_of,
    message_head,
    parse,
    parse_chunk,
    read_body,
    records_in,
    unpack_chunk,
    walk,
)
from bridge.episode.reader import Episode

pytestmark = pytest.mark.parity
DATA = Path(os.environ.get("GST_SHARED_DATA", Path(__file__).resolve().parents[3] / "shared/data"))
CONFORMANCE = sorted((DATA / "mcap_conformance").glob("*/*.mcap"))
FOREIGN = sorted((DATA / "mcap_foreign_rosbag2").glob("*.mcap"))
Fields = list[tuple[str, Any]]


def plain(value: object) -> object:
    """Spell a value as the JSON files do."""
    if isinstance(value, bytes):
        return [str(byte) for byte in value]
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    return str(value)


def fields_of(record: McapRecord) -> Fields:
    return sorted((name, plain(value)) for name, value in vars(record).items())


def records_of(data: bytes) -> Iterator[tuple[str, Fields]]:
    """Everything our walk finds, chunks opened, message indexes left out as in the JSON files."""
    stream = io.BytesIO(data)
    for place in walk(stream, len(MAGIC), len(data) - len(MAGIC)):
        if place.opcode == mcap_format.CHUNK:
            inner = unpack_chunk(parse_chunk(read_body(stream, place)))
            for opcode, at, length in records_in(inner):
                yield one_record(opcode, inner[at : at + RECORD_HEAD.size + length])
        elif place.opcode == mcap_format.ATTACHMENT:
            found = attachment_of(read_body(stream, place), place.offset)
            yield "Attachment", fields_of(found)
        elif place.opcode != mcap_format.MESSAGE_INDEX:
            yield one_record(place.opcode, data[place.offset : place.end])


def one_record(opcode: int, data: bytes) -> tuple[str, Fields]:
    if opcode == MESSAGE:
        head = message_head(data, 0)
        values = {
            "channel_id": head.channel_id,
            "data": data[MESSAGE_HEAD.size :],
            "log_time": head.log_time_ns,
            "publish_time": head.publish_time_ns,
            "sequence": head.sequence,
        }
        return "Message", [(name, plain(value)) for name, value in values.items()]
    record = parse(opcode, data[RECORD_HEAD.size :])
    assert record is not None
    return type(record).__name__, fields_of(record)


def expected_of(path: Path) -> list[tuple[str, Fields]]:
    records = json.loads(path.with_suffix(".json").read_text())["records"]
    return [(r["type"], sorted((name, value) for name, value in r["fields"])) for r in records]


@pytest.mark.skipif(not CONFORMANCE, reason="the shared conformance files are not here")
def test_all_conformance_files_are_here() -> None:
    assert len(CONFORMANCE) == 208


@pytest.mark.parametrize("path", CONFORMANCE, ids=lambda path: path.stem)
def test_every_record_is_as_its_json_says(path: Path) -> None:
    expected = expected_of(path)
    assert list(records_of(path.read_bytes())) == expected
    report = check_episode(path)
    assert (report.exit_code, report.faults) == (0, [])
    compare_episode(path, expected)


def compare_episode(path: Path, expected: list[tuple[str, Fields]]) -> None:
    """Compare what ``Episode`` says, with a summary or without one, with the data section."""
    ended = [kind for kind, _ in expected].index("DataEnd")
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for kind, fields in expected[:ended]:
        by_kind.setdefault(kind, []).append(dict(fields))
    channels = {record["id"]: record for record in by_kind.get("Channel", [])}
    schemas = {record["id"]: record for record in by_kind.get("Schema", [])}
    episode, file = Episode.open(path), McapFile(path)
    found = [
        (m.topic, m.type_name, plain(m.data), m.log_time_ns, m.publish_time_ns, m.sequence)
        for m in episode.messages()
    ]
    messages = sorted(by_kind.get("Message", []), key=lambda record: int(record["log_time"]))
    assert found == [
        (
            channels[m["channel_id"]]["topic"],
            schemas.get(channels[m["channel_id"]]["schema_id"], {"name": ""})["name"],
            m["data"],
            int(m["log_time"]),
            int(m["publish_time"]),
            int(m["sequence"]),
        )
        for m in messages
    ]
    assert sum(item.count for item in episode.topics().values()) == len(messages)
    summary = file.summary
    assert {str(key): dict(fields_of(c)) for key, c in summary.channels.items()} == channels
    assert {str(key): dict(fields_of(s)) for key, s in summary.schemas.items()} == schemas
    assert [dict(fields_of(a)) for a in file.attachments()] == by_kind.get("Attachment", [])
    assert [dict(fields_of(m)) for m in file.metadata] == by_kind.get("Metadata", [])
    assert [dict(fields_of(file.header))] == by_kind["Header"]


@pytest.mark.skipif(not FOREIGN, reason="the shared rosbag2 files are not here")
def test_the_foreign_files_hold_what_their_note_says() -> None:
    counts = {path.stem: check_episode(path).messages for path in FOREIGN}
    assert counts == {
        "cdr_test_0": 7,
        "foxglove_sdk_empty": 0,
        "multiple_files_0": 1324,
        "only_services": 12,
        "only_topics": 7,
        "rewriter_a_0": 150,
        "talker": 20,
        "wbag_0": 1246,
    }


@pytest.mark.parametrize("path", FOREIGN, ids=lambda path: path.stem)
def test_bags_of_other_programs_read_byte_for_byte(path: Path) -> None:
    with path.open("rb") as stream:
        theirs = [
            (c.topic, s.name if s else "", m.log_time, m.publish_time, m.sequence, m.data)
            for s, c, m in make_reader(stream, validate_crcs=True).iter_messages()
        ]
    episode = Episode.open(path)
    assert list(map(tuple, episode.messages())) == theirs
    for topic, item in episode.topics().items():
        assert item.count == sum(message[0] == topic for message in theirs)
    report = check_episode(path)
    assert (report.exit_code, report.faults) == (0, [])
