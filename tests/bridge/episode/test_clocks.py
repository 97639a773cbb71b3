"""Clocks of other hosts: measured by round trips, fitted, named when set, taken out of stamps."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_samples import at_positions

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.cdr.codec import decode
from bridge.episode.cdr.messages import stamp_of, transforms_from_cdr
from bridge.episode.clocks import (
    SourceClock,
    StampCorrection,
    StampWatch,
    fit_line,
    open_episode,
    read_round_trip,
    to_record,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.streams import joint_track
from bridge.episode.topics import CLOCKS
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError

START_NS = 1_700_000_000 * NS_PER_S
JOINTS = "/lab/joint_states"


class Host:
    """A clock that is ahead and drifts, behind a network that takes its time."""

    def __init__(self, seed: int, *, ahead_ns: float = 0.0, drift: float = 0.0) -> None:
        """Choose the clock."""
        self.rng = np.random.default_rng(seed)
        self.ahead_ns, self.drift = ahead_ns, drift

    def offset_ns(self, at_ns: int) -> float:
        return self.ahead_ns + self.drift * (at_ns - START_NS)

    def reading(self, at_ns: int):  # noqa: ANN201
        there, work, back = (int(each) for each in self.rng.exponential((3e5, 5e4, 3e5)))
        received_ns, sent_ns = at_ns + there, at_ns + there + work
        return read_round_trip(
            asked_ns=at_ns,
            received_ns=received_ns + round(self.offset_ns(received_ns)),
            sent_ns=sent_ns + round(self.offset_ns(sent_ns)),
            back_ns=sent_ns + back,
        )


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    ahead_ns=st.floats(-1e12, 1e12),
    drift=st.floats(-1e-4, 1e-4),
    seconds=st.integers(2, 300),
)
def test_law_the_truth_lies_within_the_uncertainty(
    seed: int, ahead_ns: float, drift: float, seconds: int
) -> None:
    """However unequal the ways are: each reading holds the offset, and so does the line."""
    host = Host(seed, ahead_ns=ahead_ns, drift=drift)
    readings = [host.reading(START_NS + k * NS_PER_S) for k in range(seconds)]
    wander_ns = abs(drift) * 1e7  # within one round trip
    for reading in readings:
        off_ns = abs(reading.offset_ns - host.offset_ns(reading.at_ns))
        assert off_ns <= reading.error_ns + wander_ns + 2
    line = fit_line(readings)
    middle_ns = sorted(reading.error_ns for reading in readings)[(seconds - 1) // 2]
    for reading in readings:
        if reading.error_ns <= middle_ns:  # the quicker half, which is used
            off_ns = abs(line.offset_at(reading.at_ns) - host.offset_ns(reading.at_ns))
            assert off_ns <= line.uncertainty_ns + wander_ns + 2


def test_a_clock_that_is_set_is_named_once_with_how_far() -> None:
    host = Host(2, ahead_ns=5e6)
    clock = SourceClock(source="lab", host="cell-pc")
    jumps = [clock.add(host.reading(START_NS + k * NS_PER_S)) for k in range(60)]
    host.ahead_ns += 3600e9
    jumps += [clock.add(host.reading(START_NS + k * NS_PER_S)) for k in range(60, 120)]
    named = [jump for jump in jumps if jump is not None]
    assert len(named) == 1
    assert named[0].by_ns == pytest.approx(3600e9, abs=5e6)
    assert named[0].at_ns == pytest.approx(START_NS + 60 * NS_PER_S, abs=NS_PER_S)
    assert clock.sentences()[-1].startswith("the clock of lab on cell-pc was set ahead by 3600.")
    assert [round(line.offset_ns / 1e9) for line in clock.lines()] == [0, 3600]


def test_drift_and_a_slow_network_are_no_jump() -> None:
    """Law: of 20 hosts with 200 ppm and delays of any length none is said to have been set."""
    for seed in range(20):
        host = Host(seed, ahead_ns=1e9, drift=200e-6)
        clock = SourceClock(source="lab", host="x")
        for k in range(600):
            clock.add(host.reading(START_NS + k * NS_PER_S))
        assert not clock.jumps


def test_stamps_alone_show_a_jump_but_no_stall_and_no_playback() -> None:
    def told(delays_s: list[float]) -> list[float]:
        watch = StampWatch()
        found = (watch.see(JOINTS, round(delay_s * 1e9)) for delay_s in delays_s)
        return [round(by_ns / 1e9, 3) for by_ns in found if by_ns]

    assert told([0.001] * 5 + [-2.0] * 5) == [2.001]
    assert told([0.001] * 5 + [3600.0] * 5) == [-3599.999]
    assert told([0.001] * 5 + [0.4] + [0.001] * 5) == []  # one bad second
    assert told([0.001] * 5 + [0.3] * 5) == []  # a queue on the way
    assert told([k * 1.0 for k in range(20)]) == []  # played back at half the rate
    assert told([1e6 + k // 5 for k in range(20)]) == []  # played back, with pauses


def _joints(stamp_ns: int) -> bytes:
    return at_positions(stamp_ns, ("a",), np.ones(1)).to_cdr()


def _write(path: Path, host: Host, *, seconds: int = 30, jump_at: int | None = None) -> None:
    """An episode of one source whose clock is wrong, with the readings of its recorder."""
    clock = SourceClock(source="lab", host="cell-pc", topics=frozenset((JOINTS, "/tf")))
    jumped_ns = 0
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial", cell="lab"))
        for k in range(seconds * 10):
            now_ns = START_NS + k * NS_PER_S // 10
            if jump_at is not None and k == jump_at * 10 + 5:
                host.ahead_ns += 60e9
                jumped_ns = now_ns
            source_ns = now_ns + round(host.offset_ns(now_ns))
            for topic in (JOINTS, "/other/x"):
                writer.write(
                    topic,
                    _joints(source_ns),
                    schema_record=schema.schema_for(schema.JOINT_STATE),
                    message_encoding="cdr",
                    log_time_ns=now_ns + 200_000,
                    publish_time_ns=source_ns,
                    sequence=k,
                )
            if k % 10 == 0:
                record = to_record(clock, "1", [host.reading(now_ns)])
                log_ns = now_ns + 300_000
                writer.write(CLOCKS, record, type_name=schema.CLOCKS, log_time_ns=log_ns)
    assert (jump_at is None) == (jumped_ns == 0)


def test_stamps_are_read_in_the_recorders_time_where_it_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "t.mcap"
    _write(path, Host(3, ahead_ns=7.5e9, drift=30e-6))
    recorded, corrected = open_episode(path), open_episode(path, clock="corrected")
    wrong = np.array([m.publish_time_ns - m.log_time_ns for m in recorded.messages([JOINTS])])
    assert wrong.min() > 7.4e9
    for message in corrected.messages([JOINTS]):
        assert abs(message.publish_time_ns - (message.log_time_ns - 200_000)) < 1e6
        assert stamp_of(decode(message.type_name, message.data)) == message.publish_time_ns
    track, payloads = joint_track(corrected), corrected.payloads([JOINTS])[0]
    assert [stamp_of(decode(schema.JOINT_STATE, data)) for data in payloads] == list(
        track.stamps_ns
    )
    others = [list(each.messages(["/other/x"])) for each in (recorded, corrected)]
    assert others[0] == others[1]  # nobody measured that clock


def test_an_episode_without_readings_says_so(tmp_path: Path) -> None:
    path = tmp_path / "t.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="t", kind="trial"))
    with pytest.raises(EpisodeError, match="holds no clock readings"):
        open_episode(path, clock="corrected")


def test_sources_that_share_a_topic_and_differ_are_left_alone() -> None:
    clocks = []
    for seed, ahead_ns in enumerate((0.0, 5e9)):
        host = Host(seed, ahead_ns=ahead_ns)
        clock = SourceClock(source=f"s{seed}", host="x", topics=frozenset((f"/{seed}", "/tf")))
        for k in range(30):
            clock.add(host.reading(START_NS + k * NS_PER_S))
        clocks.append(clock)
    correction = StampCorrection(clocks)
    at_ns = START_NS + 10 * NS_PER_S
    assert correction.shift_ns("/tf", at_ns, at_ns) == 0
    assert correction.shift_ns("/1", at_ns, at_ns) == pytest.approx(-5e9, abs=1e6)


def test_every_kind_of_stamp_is_moved_and_unset_ones_stay(tmp_path: Path) -> None:
    from bridge.episode.cdr.messages import FrameTransform, transforms_to_cdr

    transform = FrameTransform(stamp_ns=START_NS, parent="a", child="b", T_parent_child=np.eye(4))
    event = {"schema_version": 1, "stamp_ns": START_NS, "type": "note", "text": "x"}
    kinds = {
        "/tf": (schema.TF_MESSAGE, transforms_to_cdr([transform])),
        "/lab/event": (schema.EVENT, json.dumps(event).encode()),
        "/lab/unset": (schema.JOINT_STATE, _joints(0)),
        "/lab/broken": (schema.JOINT_STATE, b"\0\1"),
    }
    host = Host(1, ahead_ns=1e9)
    clock = SourceClock(source="lab", host="x", topics=frozenset(kinds))
    path = tmp_path / "t.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="t", kind="trial"))
        readings = [host.reading(START_NS + k * NS_PER_S) for k in range(3)]
        record = to_record(clock, "1", readings)
        writer.write(CLOCKS, record, type_name=schema.CLOCKS, log_time_ns=START_NS)
        for topic, (type_name, data) in kinds.items():
            known = schema.schema_for(type_name)
            assert known is not None
            writer.write(
                topic,
                data,
                schema_record=known,
                message_encoding=known.message_encoding,
                log_time_ns=START_NS,
                publish_time_ns=START_NS,
                sequence=0,
            )
    episode = open_episode(path, clock="corrected")
    found = {message.topic: message.data for message in episode.messages(kinds)}
    moved = pytest.approx(START_NS - 1e9, abs=2e6)
    assert transforms_from_cdr(found["/tf"])[0].stamp_ns == moved
    assert json.loads(found["/lab/event"])["stamp_ns"] == moved
    assert found["/lab/unset"] == _joints(0)
    assert found["/lab/broken"] == b"\0\1"
