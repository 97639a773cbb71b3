"""Sequence numbers, the bounded queue, the ledger, latched messages: nothing is lost silently."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.episode import schema
from bridge.episode.records import FrameTransform, transforms_to_cdr
from bridge.record.config import RecorderConfig
from bridge.record.inspection import Finding, inspect
from bridge.record.intake import Command, Dropped, Intake, Received
from bridge.record.latched import LatchedMessages
from bridge.record.ledger import Ledger
from bridge.record.sequence import SequenceTracker
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]


def plain_sample(sequence: int | None, gid: bytes = b"g" * 16) -> WireSample:
    return WireSample(
        topic="/t",
        type_name="",
        message_encoding="",
        data=b"x",
        source_ns=0,
        sequence=sequence,
        source_gid=gid,
        received_ns=0,
    )


@given(st.sets(st.integers(0, 60), min_size=1))
def test_gaps_plus_received_is_what_was_sent_in_between(kept: set[int]) -> None:
    tracker = SequenceTracker()
    gaps = sum(tracker.observe(plain_sample(n)).gap for n in sorted(kept))
    assert gaps + len(kept) == max(kept) - min(kept) + 1


def test_a_restarted_publisher_is_no_gap() -> None:
    tracker = SequenceTracker()
    tracker.observe(plain_sample(500))
    assert tracker.observe(plain_sample(0, gid=b"h" * 16)).gap == 0
    assert tracker.observe(plain_sample(501)).gap == 0


def test_a_repeated_number_is_counted_and_no_gap() -> None:
    tracker = SequenceTracker()
    assert [tracker.observe(plain_sample(n)) for n in (0, 2, 1, 3)] == [
        (0, False),
        (1, False),
        (0, True),
        (0, False),
    ]


def test_without_numbers_nothing_is_claimed() -> None:
    tracker = SequenceTracker()
    assert [tracker.observe(plain_sample(None)).gap for _ in range(3)] == [0, 0, 0]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 400_000), max_size=40), st.integers(0, 3))
def test_every_message_is_kept_or_counted(sizes: list[int], missing: int) -> None:
    """Law: received + queue drops + gaps = sent, whatever the sizes and whatever fits."""
    intake = Intake(RecorderConfig(queue_mb=1, small_reserve_mb=0))
    ledger = Ledger()
    sequence = 0
    for number, size in enumerate(sizes):
        sample = plain_sample(sequence)
        intake.put(
            replace(sample, data=bytes(size), received_ns=number * 10**8)
        )
        sequence += 1 + (missing if number + 1 < len(sizes) else 0)
    while (entry := intake.get(0.0)) is not None:
        if isinstance(entry, Received):
            ledger.count_received(entry, Finding.GOOD)
        elif isinstance(entry, Dropped):
            ledger.count_dropped(entry)
    total = ledger.total()
    assert total.received + total.queue_drops == len(sizes)
    assert total.received + total.queue_drops + total.gaps == sequence
    assert intake.queued_bytes == 0
    by_second = list(ledger.close_seconds())
    assert sum(record["received"] for record in by_second) == total.received
    assert sum(record["queue_drops"] for record in by_second) == total.queue_drops
    assert ledger.total() == total  # closing the seconds changes no total


def test_images_never_evict_joints(make_sample: MakeSample) -> None:
    intake = Intake(RecorderConfig(queue_mb=2, small_reserve_mb=1))
    for _ in range(20):
        intake.put(make_sample(topic="/cell/cam/a/depth/image", data=bytes(200_000)))
    for _ in range(100):
        intake.put(make_sample())
    entries = []
    while (entry := intake.get(0.0)) is not None:
        entries.append(entry)
    joints = [e for e in entries if isinstance(e, Received) and "joint" in e.sample.topic]
    dropped = [e for e in entries if isinstance(e, Dropped)]
    assert len(joints) == 100
    assert sum(c.messages for d in dropped for c in d.counts.values()) == 20 - 4


def test_commands_keep_their_place_and_are_never_dropped(make_sample: MakeSample) -> None:
    intake = Intake(RecorderConfig(queue_mb=1, small_reserve_mb=0))
    first = make_sample(data=bytes(900_000))
    intake.put(first)
    command = Command(action=None, received_ns=0)
    intake.put(make_sample(data=bytes(900_000)))
    intake.put_command(command)
    intake.put(make_sample(data=b""))
    kinds = [type(intake.get(0.0)) for _ in range(4)]
    assert kinds == [Received, Dropped, Command, Received]


def test_newer_json_is_flagged_and_broken_messages_are_found(make_sample: MakeSample) -> None:
    good = make_sample().data
    assert inspect(schema.JOINT_STATE, "cdr", good) is Finding.GOOD
    assert inspect(schema.JOINT_STATE, "cdr", good[:-3]) is Finding.UNDECODABLE
    assert inspect(schema.JOINT_STATE, "json", good) is Finding.UNDECODABLE
    assert inspect(schema.EVENT, "json", b'{"schema_version": 1}') is Finding.GOOD
    assert inspect(schema.EVENT, "json", b'{"schema_version": 99}') is Finding.NEWER_VERSION
    assert inspect(schema.EVENT, "json", b"{") is Finding.UNDECODABLE
    assert inspect("my/Thing", "cdr", b"") is Finding.UNKNOWN_TYPE


@given(st.binary(max_size=200))
def test_inspection_never_raises(data: bytes) -> None:
    for name in (schema.JOINT_STATE, schema.IMAGE, schema.TF_MESSAGE, schema.PLAN, "x"):
        assert isinstance(inspect(name, "", data), Finding)


def static_transform(*children: str) -> bytes:
    return transforms_to_cdr(
        [
            FrameTransform(stamp_ns=0, parent="base", child=child, T_parent_child=np.eye(4))
            for child in children
        ]
    )


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
