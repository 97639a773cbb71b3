"""Messages as nobody should send them, over the wire from another process."""

import base64
import json
import os
import struct
import time
import uuid
from typing import Any

import numpy as np
import pytest
from fault_account import LiveCell, accounts_are_exact, check_code, ledger, lost, metadata, read
from fault_messages import color, depth_mm, image, joints, jpeg

from bridge.episode import schema
from bridge.episode.topics import DROPS
from bridge.wire.publisher import Attachment, encode

GID, OTHER_GID = b"g" * 16, b"h" * 16


def note_of(sequence: int, source_ns: int, gid: bytes, form: int) -> bytes | None:
    """The attachment of a message: 33 or 77 bytes, none (0), or so many bytes of rubbish."""
    if form == 33:
        return encode(Attachment(sequence=sequence, source_ns=source_ns, gid=gid))
    if form == 77:
        named = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")
        values = (struct.pack("<q", sequence), struct.pack("<q", source_ns), b"\x10" + gid)
        return b"".join(name + value for name, value in zip(named, values, strict=True))
    return os.urandom(form) if form else None


def put(topic: str, data: bytes, sequence: int, **options: Any) -> dict[str, Any]:
    """One message for the publisher's process."""
    gid = options.get("gid", GID)
    form = options.get("form", 33)
    note = note_of(sequence, options.get("source_ns", time.time_ns()), gid, form)
    return {
        "topic": topic,
        "key": options.get("key", topic[1:]),
        "encoding": options.get("encoding", f"application/cdr;{schema.JOINT_STATE}"),
        "data": base64.b64encode(data).decode(),
        "note": None if note is None else base64.b64encode(note).decode(),
        "sequence": sequence if form in (33, 77) else None,
        "gid": gid.hex() if form in (33, 77) else "",
    }


def of_type(type_name: str) -> str:
    return f"application/cdr;{type_name}"


def test_broken_messages_are_kept_flagged_and_counted(live: LiveCell) -> None:
    good_jpeg, depth = jpeg(48, 64), depth_mm(24, 32)
    wrong_size = image(depth, "16UC1", height=30)
    wrong_step = image(depth, "16UC1", step=40, data=depth.tobytes()[: 24 * 40])
    compressed, raw = of_type(schema.COMPRESSED_IMAGE), of_type(schema.IMAGE)
    broken = [
        put("/cell/joint_states", joints()[:-5], 1),
        put("/cell/joint_states", b"", 2),
        put("/cell/joint_states", b"\x00\x01" + b"\xa5" * 500, 3),
        put("/cell/cam/a/color/image", color(good_jpeg[:-200]), 1, encoding=compressed),
        put("/cell/cam/a/color/image", color(good_jpeg)[:20], 2, encoding=compressed),
        put("/cell/cam/a/depth/image", wrong_size, 1, encoding=raw),
        put("/cell/cam/a/depth/image", wrong_step, 2, encoding=raw),
        put("/cell/cam/a/depth/image", image(depth, "16UC1")[:-7], 3, encoding=raw),
    ]
    good = [
        put("/cell/joint_states", joints(), 0),
        put("/cell/joint_states", joints() + b"trailing", 4),  # as other readers, we pass it over
        put("/cell/cam/a/color/image", color(good_jpeg), 0, encoding=compressed),
        put("/cell/cam/a/depth/image", image(depth, "16UC1"), 0, encoding=raw),
    ]
    live.start("broken")
    live.put(*good, *broken)
    answer = live.stop()
    topics = accounts_are_exact(live.path("broken"), live.sent())
    assert (answer["messages"], answer["lost"]) == (12, 0)
    found = {topic: tally["undecodable"] for topic, tally in topics.items()}
    assert found == {
        "/cell/joint_states": 3,
        "/cell/cam/a/color/image": 2,
        "/cell/cam/a/depth/image": 3,
    }
    assert check_code(live.path("broken")) == 1  # the messages are broken, and it says so


@pytest.mark.parametrize("is_new", [True, False])
def test_a_publisher_that_counts_from_zero_again_has_lost_nothing(
    live: LiveCell, is_new: bool
) -> None:
    """Law: a numbering that begins anew is no gap, under a new identity or the old one."""
    name = f"reset_{is_new}".lower()
    after = OTHER_GID if is_new else GID
    first = [put("/cell/joint_states", joints(n), n) for n in range(100)]
    second = [put("/cell/joint_states", joints(n + 500), n, gid=after) for n in range(30)]
    live.start(name)
    live.put(*first, *second)
    answer = live.stop()
    tally = ledger(live.path(name))["/cell/joint_states"]
    assert (answer["messages"], answer["lost"], tally["repeated"]) == (130, 0, 0)
    assert sorted(s.digest for s in live.sent()) == sorted(f.digest for f in read(live.path(name)))
    assert check_code(live.path(name)) == 0


@pytest.mark.parametrize(
    ("sequence", "source_ns"),
    [(-(2**63), -(2**63)), (-1, -1), (2**63 - 1, 2**63 - 1), (2**32, 0), (0, 2**62)],
)
def test_numbers_and_times_no_publisher_has_are_recorded_all_the_same(
    live: LiveCell, sequence: int, source_ns: int
) -> None:
    """Law: an attachment may say anything; the message is kept, and nothing is claimed of it."""
    name = f"extreme{abs(sequence)}_{source_ns < 0}".lower()
    gid = uuid.uuid4().bytes
    live.start(name)
    live.put(
        put("/cell/joint_states", joints(1), sequence, source_ns=source_ns, gid=gid),
        put("/cell/joint_states", joints(2), 7, gid=uuid.uuid4().bytes),
    )
    answer = live.stop()
    assert (answer["messages"], answer["lost"], answer["undecodable"]) == (2, 0, 0)
    assert [f.digest for f in read(live.path(name))] == [s.digest for s in live.sent()]
    assert check_code(live.path(name)) == (3 if source_ns > 2**62 else 0)  # no time of today


ODD_TOPICS = (
    "/größe/übung/関節",
    "/with space/and  two",
    "/100%/%2F/%00",
    '/quo"te/back\\slash/{json}/<b>',
    "/" + "long/" * 400 + "end",
    "/..",
    "/../../etc/passwd",
    "/tab\tnew\nline",
    "/recorder/drops2",
    "/🤖",
)


def test_odd_topic_names_change_nothing(live: LiveCell) -> None:
    raw = of_type(schema.IMAGE)
    live.start("odd")
    for topic in ODD_TOPICS:
        live.put(
            put(topic, joints(), 0),
            put(topic + "/image", image(depth_mm(8, 8), "16UC1"), 0, encoding=raw),
        )
    live.stop()
    path = live.path("odd")
    topics = accounts_are_exact(path, live.sent())
    assert len(topics) == 2 * len(ODD_TOPICS)
    assert check_code(path) == 0
    assert [p.name for p in live.cell.folder.glob("**/passwd")] == []


def test_an_episode_without_messages_is_whole(live: LiveCell) -> None:
    live.start("empty")
    answer = live.stop()
    assert (answer["messages"], answer["lost"]) == (0, 0)
    assert read(live.path("empty")) == []
    assert metadata(live.path("empty"), "drops")["topics"] == {}
    assert [each["name"] for each in answer["findings"]] == ["nothing_recorded"]
    assert check_code(live.path("empty")) == 3  # whole, and named


VERBS = ("start", "stop", "mark", "label", "list", "status")
GARBAGE = (
    b"\x00", b"\xff\xfe\xfd", b"{", b"null", b"[]", b"1e999", b'"text"', b"[" * 5000,
    b'{"id": 7}', b'{"id": null}', b'{"id": ["a"]}', b'{"id": {}}', b'{"id": "a/b"}',
    b'{"id": "\\u0000"}', b'{"id": "' + b"x" * 5000 + b'"}', b'{"last": -1}', b'{"text": {}}',
    b'{"outcome": 3}', b'{"outcome": {"result": []}}', b'{"episode": ["../x"]}', b'{"info": 3}',
    b'{"id": "ok", "info": {"tags": 3}}', b'{"id": "ok", "info": {"kind": []}}', b'{"": 1}',
)  # fmt: skip


def test_requests_of_rubbish_are_refused_and_cost_the_episode_nothing(live: LiveCell) -> None:
    """Law: no request but a right one changes what is recorded."""
    rng = np.random.default_rng(2)
    live.start("asked")
    live.put(*[put("/cell/joint_states", joints(n), n) for n in range(10)])
    refused = 0
    for verb in VERBS:
        for payload in (*GARBAGE, *(rng.bytes(int(n)) for n in rng.integers(1, 300, 5))):
            answer = live.publisher.ask(verb, payload)
            refused += "refused" in answer
            if verb not in ("status", "list"):
                assert "refused" in answer, (verb, payload[:80], answer)
            assert "Traceback" not in str(answer)
    live.put(*[put("/cell/joint_states", joints(n), n) for n in range(10, 20)])
    status = live.publisher.ask("status")["ok"]
    assert (status["ok"], status["state"], status["episode"]) == (True, "recording", "asked")
    answer = live.stop()
    assert (answer["messages"], answer["lost"]) == (20, 0)
    assert refused > 4 * len(GARBAGE)
    assert check_code(live.path("asked")) == 0
    assert lost(ledger(live.path("asked"))["/cell/joint_states"]) == 0


def test_nobody_else_writes_into_the_ledger(live: LiveCell) -> None:
    """Law: what the accounts of an episode say comes from its recorder alone."""
    lie = {"schema_version": 1, "topic": "/cell/joint_states", "second": 1, "gaps": 1000}
    data = json.dumps(lie).encode()
    live.start("forged")
    live.put(
        put("/cell/joint_states", joints(), 0),
        put(DROPS, data, 0, encoding=f"application/json;{schema.DROPS}"),
    )
    answer = live.stop()
    path = live.path("forged")
    topics = ledger(path)  # the seconds add up to the totals
    assert answer["lost"] == topics[DROPS]["queue_drops"] == 1
    assert topics["/cell/joint_states"]["gaps"] == 0
    assert any(DROPS in text for text in metadata(path, "drops")["warnings"])
    assert check_code(path) == 3
