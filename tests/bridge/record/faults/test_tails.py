"""The end of a stream, over a real network: lost and counted, or said not to be known."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from fault_account import lost, metadata, read
from live_recorder import LiveRecorder, open_recorder
from loopback import free_endpoint
from patience import wait_until

from bridge.episode.check import check_episode
from bridge.record import clocks as record_clocks
from bridge.wire.clocks import announce, ask_clocks
from bridge.wire.config import WireConfig
from bridge.wire.publisher import WirePublisher
from bridge.wire.session import WireSession, open_session

TOPIC = "/lab/odd"


@pytest.fixture
def live(tmp_path: Path) -> Iterator[tuple[LiveRecorder, WireConfig]]:
    endpoint = free_endpoint()
    wire = WireConfig(mode="router", connect=(), listen=(endpoint,))
    with open_recorder(tmp_path / "run", wire=wire) as recorder:
        recorder.start("t1", cell="lab")
        yield recorder, WireConfig(connect=(endpoint,))


def publish(session: WireSession, kept: int = 50, lost: int = 7) -> WirePublisher:
    """Send so many, then lose the last ones, as zenoh does where the network is behind."""
    publisher = session.publisher(TOPIC, "odd_msgs/msg/Odd")
    for number in range(kept):
        publisher.put(b"x", source_ns=number)
    publisher.skip(lost)
    return publisher


def stopped(recorder: LiveRecorder, *, sent: int, tails: list[str]) -> int:
    """Stop, see that the file agrees with the answer; returns what was lost."""
    answer = recorder.stop()
    path = recorder.run.episodes_dir / f"{answer['episode']}.mcap"
    found = [each for each in read(path) if each.topic == TOPIC]
    drops = metadata(path, "drops")
    assert answer["uncounted_tails"] == drops["uncounted_tails"] == tails
    assert len(found) + lost(drops["topics"][TOPIC]) == sent
    told = [note for note in check_episode(path).notes if note.startswith("tail not known")]
    assert [TOPIC in note for note in told] == [True] * len(tails)
    return answer["lost"]


def test_what_is_lost_before_a_stop_is_counted(live: tuple[LiveRecorder, WireConfig]) -> None:
    recorder, wire = live
    with open_session(wire) as source:
        announce(source, "lab", has_clock=False)
        publisher = publish(source)
        wait_until(lambda: recorder.status()["messages"] > 0, "the source")  # who is heard is asked
        assert stopped(recorder, sent=57, tails=[]) == 7
        recorder.start("t2", cell="lab")
        publisher.put(b"x", source_ns=1)  # it goes on, and nothing is counted twice
        assert stopped(recorder, sent=1, tails=[]) == 0
        assert not recorder.status()["clocks"]


def test_a_source_that_ends_says_what_it_has_sent(live: tuple[LiveRecorder, WireConfig]) -> None:
    recorder, wire = live
    with open_session(wire) as source:
        announce(source, "lab")
        publish(source)
    assert stopped(recorder, sent=57, tails=[]) == 7


def test_of_a_source_that_was_killed_the_tail_is_not_known(
    live: tuple[LiveRecorder, WireConfig],
) -> None:
    recorder, wire = live
    with open_session(wire) as other, open_session(wire) as source:
        announce(other, "lab")
        publish(other)
        announce(source, "lab")
        publish(source, kept=3)
        wait_until(lambda: len(recorder.status()["clocks"]) == 2, "both sources")
        source._inner.close()  # as the end of its process does
        assert stopped(recorder, sent=60, tails=[TOPIC]) == 7
    found = check_episode(recorder.run.episodes_dir / "t1.mcap").findings
    assert [(each.name, each.about) for each in found if "tail" in each.name] == [
        ("tail_untold", TOPIC)
    ]


def test_answers_of_wrong_shape_count_nothing_and_end_nothing(
    live: tuple[LiveRecorder, WireConfig],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(record_clocks, "SETTLE_S", 0.3)
    recorder, wire = live
    with open_session(wire) as source:
        gid = publish(source).gid.hex()
        tables = (
            *([], 7, None, {TOPIC: 7}, {TOPIC: {gid: "57"}}, {TOPIC: {gid: 57.0}}),
            *({TOPIC: {gid: True}}, {TOPIC: {gid: -1}}, {TOPIC: {gid: 2**63}}),
            *({TOPIC: {"no hex": 57}}, {TOPIC: {gid[2:]: 57}}, {TOPIC: {gid: 2**62}}),
            {TOPIC: {gid: 57}, **{f"/{k}": {gid: 1} for k in range(100_000)}},  # too large
        )
        words = [json.dumps({"sent": table}).encode() for table in tables]
        words += [b"", b"[]", b"[" * 100_000, b'{"sent": {"a": ' * 9, b"\xff"]
        words += [b'{"received_ns":"x","sent_ns":1}', b'{"received_ns":1}']
        words += [b'{"received_ns": 1, "sent_ns": 2}']
        for number, text in enumerate(words):
            source.serve(f"@clock/s{number}", lambda request, text=text: text)
            source.query(f"@sent/s{number}", text, timeout_s=20.0)
        answers = ask_clocks(recorder.session, timeout_s=20.0)
        found = [(each.source, each.reading is not None, each.topics) for each in answers]
        assert sorted(found) == [("s11", False, frozenset()), ("s20", True, frozenset())]
        mute = threading.Event()
        source.serve("@clock/mute", lambda request: b"{}" if mute.wait(20.0) else b"")
        try:
            assert stopped(recorder, sent=50, tails=[TOPIC]) == 0
        finally:
            mute.set()
    assert recorder.session.receive_errors == 0
    assert "Traceback" not in capfd.readouterr().err
