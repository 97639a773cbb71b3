"""The queues: bounded in bytes, in order, images apart from joints, every loss counted."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.episode import schema
from bridge.record import queue
from bridge.record.config import QueueConfig
from bridge.record.inspection import MessageState
from bridge.record.ledger import Ledger
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]


class Queues:
    """An input_queue whose images wait until they are let through."""

    def __init__(self, **limits: object) -> None:
        """Open the queues."""
        self.images: deque[queue.Item] = deque()
        self.input_queue = queue.InputQueue(QueueConfig(**limits), self._take)  # type: ignore[arg-type]

    def _take(self, item: queue.Item, is_watched: bool) -> bool:
        self.images.append(item)
        return True

    def encode(self, count: int | None = None) -> None:
        for _ in range(len(self.images) if count is None else count):
            self.input_queue.put_image(self.images.popleft(), 0)

    def drain(self) -> list[queue.Entry]:
        self.encode()
        merge = queue.Merge()
        merge.feed(*self.input_queue.take())
        entries = list(merge.ready())
        for entry in entries:
            if isinstance(entry, queue.Item):
                self.input_queue.release(entry)
        return entries


def image(number: int, size: int, **changes: object) -> WireSample:
    sample = WireSample(
        topic="/cell/cam/a/depth/image",
        type_name=schema.IMAGE,
        message_encoding="cdr",
        data=bytes(size),
        source_ns=None,
        sequence=number,
        source_gid=b"c" * 16,
        received_ns=number * 10**7,
    )
    return replace(sample, **changes)  # type: ignore[arg-type]


def command() -> queue.Command:
    return queue.Command(action=lambda command: None, received_ns=0)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 400_000), st.booleans(), st.integers(0, 2)), max_size=40),
    st.integers(0, 40),
)
def test_every_message_is_kept_or_counted(
    messages: list[tuple[int, bool, int]], encoded: int
) -> None:
    """Law: received + queue drops + gaps = sent, whatever the sizes and whatever fits."""
    queues = Queues(camera_queue_mb=1, small_queue_mb=1, max_message_mb=0.3, max_rate_hz=30)
    ledger, sent = Ledger(), {True: 0, False: 0}
    for number, (size, is_image, missing) in enumerate(messages):
        sequence = sent[is_image]
        sample = image(sequence, size, received_ns=number * 10**8)
        if not is_image:
            sample = replace(sample, topic="/small", type_name=schema.JOINT_STATE)
        queues.input_queue.put(sample)
        is_last = not any(other == is_image for _, other, _ in messages[number + 1 :])
        sent[is_image] += 1 + (0 if is_last else missing)
        if number == encoded:
            queues.encode()
    for entry in queues.drain():
        if isinstance(entry, queue.Item):
            ledger.count_received(entry, MessageState.GOOD)
        elif isinstance(entry, queue.Dropped):
            ledger.count_dropped(entry)
    total = ledger.total()
    assert total.received + total.queue_drops == len(messages)
    assert total.received + total.lost == sum(sent.values())
    assert queues.input_queue.queued_bytes == 0
    by_second = list(ledger.close_seconds())
    for name in ("received", "queue_drops", "gaps"):
        assert sum(record[name] for record in by_second) == getattr(total, name)


def test_images_never_evict_joints(make_sample: MakeSample) -> None:
    queues = Queues(camera_queue_mb=1, small_queue_mb=1)
    for number in range(20):
        queues.input_queue.put(image(number, 200_000))
    for _ in range(100):
        queues.input_queue.put(make_sample())
    entries = queues.drain()
    joints = [e for e in entries if isinstance(e, queue.Item) and "joint" in e.sample.topic]
    dropped = [e for e in entries if isinstance(e, queue.Dropped)]
    assert len(joints) == 100
    assert sum(c.messages for d in dropped for c in d.counts.values()) == 20 - 4


def test_small_messages_have_a_bound_of_their_own(make_sample: MakeSample) -> None:
    queues = Queues(small_queue_mb=1)
    for _ in range(3000):
        queues.input_queue.put(make_sample(data=bytes(500)))
    kept = [entry for entry in queues.drain() if isinstance(entry, queue.Item)]
    assert len(kept) == 1_000_000 // (500 + 512)


def test_commands_keep_their_place_and_wait_for_the_images_before_them(
    make_sample: MakeSample,
) -> None:
    queues, merge = Queues(), queue.Merge()
    stop = command()
    queues.input_queue.put(image(0, 10))
    before = make_sample()
    queues.input_queue.put(before)
    queues.input_queue.put_command(stop)
    queues.input_queue.put(image(1, 10))
    after = make_sample()
    queues.input_queue.put(after)

    def ready() -> list[object]:
        merge.feed(*queues.input_queue.take())
        return [e.sample if isinstance(e, queue.Item) else e for e in merge.ready()]

    assert ready() == [before]  # small messages wait for no image
    assert merge.is_waiting
    queues.encode(1)
    assert ready() == [image(0, 10), stop, after]
    queues.encode(1)
    assert ready() == [image(1, 10)]


def test_an_image_from_behind_a_command_does_not_overtake_it() -> None:
    queues, merge = Queues(), queue.Merge()
    queues.input_queue.put(image(0, 10, topic="/slow/cam/a/color/image"))
    queues.input_queue.put_command(command())
    queues.input_queue.put(image(1, 10))
    slow = queues.images.popleft()
    queues.encode()
    merge.feed(*queues.input_queue.take())
    assert list(merge.ready()) == []
    queues.input_queue.put_image(slow, 0)
    merge.feed(*queues.input_queue.take())
    kinds = [type(entry) for entry in merge.ready()]
    assert kinds == [queue.Item, queue.Command, queue.Item]


def test_a_quiet_intake_queues_only_what_is_latched(make_sample: MakeSample) -> None:
    queues = Queues()
    queues.input_queue.be_quiet(0)
    queues.input_queue.put(make_sample())
    queues.input_queue.put(make_sample(topic="/tf_static"))
    queues.input_queue.put(image(0, 10))
    assert [e.sample.topic for e in queues.drain() if isinstance(e, queue.Item)] == ["/tf_static"]
    assert queues.input_queue.seen()["/cell/joint_states"] == 1
    queues.input_queue.put_command(command())
    queues.input_queue.be_quiet(0)  # too late: a command is on its way
    queues.input_queue.put(make_sample())
    assert [type(entry) for entry in queues.drain()] == [queue.Command, queue.Item]


def test_too_large_and_too_many_are_dropped_and_said(make_sample: MakeSample) -> None:
    queues = Queues(max_message_mb=0.1, max_rate_hz=5)
    queues.input_queue.put(make_sample(data=bytes(100_001), topic="/huge"))
    now_ns = make_sample().received_ns // 10**9 * 10**9
    for _ in range(8):
        queues.input_queue.put(make_sample(received_ns=now_ns))
    queues.input_queue.put(make_sample(received_ns=now_ns + 10**9))
    ledger = Ledger()
    kept = 0
    for entry in queues.drain():
        kept += isinstance(entry, queue.Item)
        if isinstance(entry, queue.Dropped):
            ledger.count_dropped(entry)
    assert kept == 5 + 1
    assert ledger.total().queue_drops == 3 + 1
    assert ledger.warnings == [
        "/huge: messages over 0.1 MB are dropped",
        "/cell/joint_states: over 5 messages a second are dropped",
    ]


@pytest.mark.slow
def test_threads_that_put_at_once_lose_nothing(make_sample: MakeSample) -> None:
    queues = Queues(max_rate_hz=10**9, small_queue_mb=1000)
    samples = [make_sample() for _ in range(5000)]

    def put(gid: bytes) -> None:
        for number, sample in enumerate(samples):
            queues.input_queue.put(replace(sample, source_gid=gid, sequence=number))

    threads = [threading.Thread(target=put, args=(bytes([n]) * 16,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    entries = queues.drain()
    assert len(entries) == 4 * len(samples)
    assert sum(entry.step.gap for entry in entries if isinstance(entry, queue.Item)) == 0
