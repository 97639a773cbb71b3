"""Sequence numbers, the ledger, inspection, latched messages: nothing is lost silently."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CompressedColor,
    DepthImage,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.record.inspection import MessageState, inspector
from bridge.record.ledger import OTHER_TOPICS, Ledger
from bridge.record.queue import DropCount, Dropped, Item, LatchedMessages
from bridge.record.sequence import MAX_HOLES, SequenceTracker, Step
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]


def numbered(sequence: int | None, gid: bytes = b"g" * 16, source_ns: int | None = 0) -> WireSample:
    return WireSample(
        topic="/t",
        type_name="",
        message_encoding="",
        data=b"x",
        source_ns=source_ns,
        sequence=sequence,
        source_gid=gid,
        received_ns=0,
    )


def item_of(sample: WireSample, step: Step, ticket: int = 0) -> Item:
    return Item(sample, step, ticket, sample.type_name, len(sample.data), False)


@given(
    st.permutations(range(30)), st.sets(st.integers(0, 29)), st.integers(0, 2**64), st.integers(0)
)
def test_reported_lost_is_truly_lost_whatever_the_order(
    order: list[int], never: set[int], start: int, told_at: int
) -> None:
    """Law: after the first number, whatever comes late is taken back; the rest is the loss."""
    tracker, ledger = SequenceTracker(), Ledger()
    arriving = [number for number in order if number not in never] or [0]
    told_at %= len(arriving)  # what its publisher has sent may be heard of at any time
    for ticket, number in enumerate(arriving):
        sample = numbered(start + number)
        ledger.count_received(item_of(sample, tracker.observe(sample, ticket), ticket), GOOD)
        if ticket == told_at:
            gap = tracker.told("/t", b"g" * 16, start + 30, 99)
            assert tracker.told("/t", b"g" * 16, start + 29, 100) == 0
            counts = {("/t", 0): DropCount(gaps=gap or 0)}
            ledger.count_dropped(Dropped(ticket=99, received_ns=0, counts=counts))
    total = ledger.total()
    missing = set(range(30)) - set(arriving)
    assert total.gaps == sum(number > arriving[0] for number in missing)  # before: not claimed
    assert (total.received, total.repeated) == (len(arriving), 0)


GOOD = MessageState.GOOD


@given(st.lists(st.integers(0, 12), max_size=40))
def test_copies_are_neither_gaps_nor_received_twice(numbers: list[int]) -> None:
    tracker, ledger = SequenceTracker(), Ledger()
    for ticket, number in enumerate([0, *numbers, 13]):
        sample = numbered(number)
        ledger.count_received(item_of(sample, tracker.observe(sample, ticket), ticket), GOOD)
    total = ledger.total()
    assert total.received - total.repeated == len({0, *numbers, 13})
    assert total.received - total.repeated + total.gaps == 14


@pytest.mark.parametrize("wrap", [2**32, 2**63])
def test_numbers_wrap_without_a_gap_and_late_ones_from_before_still_count(wrap: int) -> None:
    def raw(number: int) -> int:
        return number if number < wrap else number - (2**32 if wrap == 2**32 else 2**64)

    tracker = SequenceTracker()
    steps = [tracker.observe(numbered(raw(wrap + n)), n + 9) for n in (-3, -2, 0, 1, -1, 4)]
    assert [step.gap for step in steps] == [0, 0, 1, 0, 0, 2]
    assert steps[4].fills == 9
    assert not any(step.repeated for step in steps)


def test_a_publisher_that_counts_from_zero_again_under_its_old_name_is_no_copy() -> None:
    tracker = SequenceTracker()
    for number in (7, 8, 9):
        tracker.observe(numbered(number, source_ns=number))
    assert tracker.observe(numbered(8, source_ns=8)).repeated
    assert tracker.observe(numbered(0, source_ns=20)) == Step()
    assert tracker.observe(numbered(3, source_ns=21)) == Step(gap=2)


def test_a_jump_nobody_could_have_sent_is_another_numbering() -> None:
    tracker = SequenceTracker()
    tracker.observe(numbered(5))
    assert tracker.observe(numbered(2**40)).gap == 0
    assert tracker.observe(numbered(2**40 + 2)).gap == 1


def test_what_is_remembered_of_missing_messages_is_bounded() -> None:
    tracker = SequenceTracker()
    for number in range(0, 4 * MAX_HOLES, 2):
        tracker.observe(numbered(number))
    assert tracker._num_holes <= MAX_HOLES
    assert tracker.observe(numbered(1)).repeated  # too long ago: it stays booked as lost
    assert tracker.observe(numbered(4 * MAX_HOLES - 3)).fills is not None


def test_a_gap_booked_elsewhere_is_not_taken_back_here() -> None:
    ledger = Ledger()
    ledger.begin(10)
    for booked in (5, 9, 12, 35):
        ledger.count_received(item_of(numbered(1), Step(fills=booked), 40), GOOD)
    assert ledger.total().gaps == -2  # those of 12 and 35


def test_the_seconds_add_up_to_the_totals_also_when_they_come_late() -> None:
    ledger = Ledger()
    sample = replace(numbered(3), received_ns=10**9, source_ns=10**9 - 5)
    ledger.count_received(item_of(sample, Step(gap=3)), MessageState.UNDECODABLE, sample.source_ns)
    first = list(ledger.close_seconds())
    ledger.count_received(item_of(sample, Step(fills=0)), GOOD)
    count = DropCount(messages=2, gaps=4, fills=[0])
    ledger.count_dropped(Dropped(ticket=0, received_ns=0, counts={("/t", 1): count}))
    second = list(ledger.close_seconds())
    total = ledger.total()
    assert (first[0]["gaps"], second[0]["gaps"]) == (3, 2)
    assert total.gaps == 5
    assert (total.received, total.queue_drops, total.undecodable) == (2, 2, 1)
    assert total.lost == 7
    assert total.clock_offset_ns == 5
    assert ledger.total() == total


def test_topics_without_end_share_one_account() -> None:
    ledger = Ledger(max_topics=3)
    for number in range(9):
        sample = replace(numbered(0), topic=f"/t{number}")
        ledger.count_received(item_of(sample, Step()), GOOD)
    assert ledger.totals()[OTHER_TOPICS].received == 6
    assert ledger.total().received == 9


def jpeg_message(data: bytes) -> bytes:
    return CompressedColor(stamp_ns=0, frame_id="c", format="jpeg", data=data).to_cdr()


def test_newer_json_is_flagged_and_broken_messages_are_found(make_sample: MakeSample) -> None:
    good = make_sample().data
    assert inspector(schema.JOINT_STATE, "cdr")(good) is GOOD
    assert inspector(schema.JOINT_STATE, "cdr")(good[:-3]) is MessageState.UNDECODABLE
    assert inspector(schema.JOINT_STATE, "json")(good) is MessageState.UNDECODABLE
    assert inspector(schema.EVENT, "json")(b'{"schema_version": 1}') is GOOD
    assert inspector(schema.EVENT, "json")(b'{"schema_version": 99}') is MessageState.NEWER_VERSION
    assert inspector(schema.EVENT, "json")(b"{") is MessageState.UNDECODABLE
    assert inspector("my/Thing", "cdr")(b"") is MessageState.UNKNOWN_TYPE


def test_cut_images_are_found_without_decoding_them() -> None:
    jpeg = b"\xff\xd8" + bytes(500) + b"\xff\xd9"
    assert inspector(schema.COMPRESSED_IMAGE, "cdr")(jpeg_message(jpeg)) is GOOD
    assert inspector(schema.COMPRESSED_IMAGE, "cdr")(jpeg_message(jpeg + bytes(9))) is GOOD
    cut = jpeg_message(jpeg[:-9])
    assert inspector(schema.COMPRESSED_IMAGE, "cdr")(cut) is MessageState.UNDECODABLE
    other = jpeg_message(b"\x89PNG" + bytes(90))
    assert inspector(schema.COMPRESSED_IMAGE, "cdr")(other) is GOOD
    depth = DepthImage(stamp_ns=0, frame_id="c", depth_mm=np.zeros((4, 6), np.uint16)).to_cdr()
    assert inspector(schema.IMAGE, "cdr")(depth) is GOOD
    assert inspector(schema.IMAGE, "cdr")(depth[:-1]) is MessageState.UNDECODABLE
    wrong_size = depth.replace(b"\x04\0\0\0\x06\0\0\0", b"\x05\0\0\0\x06\0\0\0")
    assert inspector(schema.IMAGE, "cdr")(wrong_size) is MessageState.UNDECODABLE


@settings(max_examples=50)
@given(st.binary(max_size=200))
def test_inspection_never_raises(data: bytes) -> None:
    names = (schema.JOINT_STATE, schema.IMAGE, schema.COMPRESSED_IMAGE, schema.PLAN, "x")
    for name in names:
        assert isinstance(inspector(name, "")(data), MessageState)


def static_transform(*children: str) -> bytes:
    return transforms_to_cdr(
        [
            FrameTransform(stamp_ns=0, parent="base", child=child, T_parent_child=np.eye(4))
            for child in children
        ]
    )


def test_declared_topics_are_latched_for_each_publisher_within_bounds(
    make_sample: MakeSample, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bridge.record.queue.MAX_LATCHED_BYTES", 10)
    latched = LatchedMessages()
    latched.remember(make_sample(topic="/map", data=b"unknown"))
    for topic in ("/map", "/rosout"):
        latched.topics.declare(topic)
        for gid, data in ((b"a", b"old"), (b"b", b"other"), (b"a", b"newer")):
            latched.remember(make_sample(topic=topic, data=data, source_gid=gid * 16))
    assert [sample.data for sample in latched.all()] == [b"other", b"newer"]
    latched.remember(make_sample(topic="/map", data=bytes(6), source_gid=b"b" * 16))
    assert [sample.data for sample in latched.all()] == [b"newer"]  # the other is out of date
    latched.forget("/map")
    latched.remember(make_sample(topic="/map", data=bytes(10)))
    assert [len(sample.data) for sample in latched.all()] == [10]


def test_static_transforms_of_several_publishers_are_all_kept(make_sample: MakeSample) -> None:
    latched = LatchedMessages()
    for children in (("a", "b"), ("c",), ("b", "a"), ("c",)):
        latched.remember(make_sample(topic="/tf_static", data=static_transform(*children)))
    latched.remember(make_sample(topic="/cell/joint_states"))
    latched.remember(make_sample(topic="/cell/cam/x/color/info", data=b"1"))
    latched.remember(make_sample(topic="/cell/cam/x/color/info", data=b"2"))
    kept = latched.all()
    assert [sample.topic for sample in kept] == ["/tf_static", "/tf_static", kept[2].topic]
    assert kept[2].data == b"2"
    assert kept[0].data == static_transform("b", "a")
    latched.forget("/cell/")
    assert [sample.topic for sample in latched.all()] == ["/tf_static", "/tf_static"]
