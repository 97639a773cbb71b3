"""Faults inside the recorder, set off on purpose: encoders that fail, a disk that refuses."""

import errno
import os
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fault_account import check_code, ledger, lost, read
from fault_messages import JOINTS, RAW, depth_mm, image

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.record import encoders
from bridge.record.config import DiskConfig, RecorderConfig
from bridge.record.queue import Command, Item, Merge
from bridge.record.recorder import Recorder
from bridge.record.sequence import Step
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]
INFO = EpisodeInfo(id="t1", kind="trial", cell="cell")


@pytest.fixture
def raw(make_sample: MakeSample) -> MakeSample:
    pixels = np.full((24, 32, 3), 90, np.uint8)
    data = image(pixels, "rgb8")

    def make(**changes: object) -> WireSample:
        return make_sample(topic=RAW, type_name=schema.IMAGE, data=data, **changes)

    return make


@pytest.mark.parametrize("error", [ValueError, MemoryError, ZeroDivisionError])
def test_an_encoder_that_raises_costs_no_image(
    recorder: Recorder,
    run: RunFolder,
    raw: MakeSample,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: type[Exception],
) -> None:
    """Law: an image that cannot be encoded is recorded as it came; a good image stays good."""

    def fail(*_: object) -> bytes:
        raise error("on purpose")

    recorder.start(INFO)
    with monkeypatch.context() as patch:
        patch.setattr(encoders, "image_to_jpeg", fail)
        for number in range(3):
            recorder.receive(raw(sequence=number))
        answer = recorder.stop()
    path = run.episodes_dir / "t1.mcap"
    assert (answer["messages"], answer["lost"], answer["undecodable"]) == (3, 0, 0)
    assert [f.schema_name for f in read(path)] == [schema.IMAGE] * 3
    assert "on purpose" in capsys.readouterr().err
    assert check_code(path) == 0
    recorder.start(replace(INFO, id="t2"))  # the thread lives
    recorder.receive(raw(sequence=3))
    assert recorder.stop()["undecodable"] == 0
    assert [f.schema_name for f in read(run.episodes_dir / "t2.mcap")] == [schema.COMPRESSED_IMAGE]


def test_depth_that_cannot_be_compacted_is_kept_raw(
    run: RunFolder, make_sample: MakeSample, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(run, now_ns=AnchoredClock().now_ns, config=RecorderConfig(depth="compact"))
    recorder.start(INFO)
    sent = image(depth_mm(8, 8), "16UC1")
    with monkeypatch.context() as patch:
        patch.setattr(encoders, "depth_to_compact", lambda data: None)
        recorder.receive(
            make_sample(topic="/cell/cam/a/depth/image", type_name=schema.IMAGE, data=sent)
        )
        recorder.stop()
    recorder.close()
    (found,) = read(run.episodes_dir / "t1.mcap")
    assert found.schema_name == schema.IMAGE
    assert check_code(run.episodes_dir / "t1.mcap") == 0


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EDQUOT, errno.EROFS])
def test_a_write_that_is_refused_in_the_middle_of_many_loses_none_silently(
    run: RunFolder, raw: MakeSample, make_sample: MakeSample, monkeypatch: pytest.MonkeyPatch,
    number: int,
) -> None:  # fmt: skip
    """Law: whatever the disk says, each message received before is written or counted."""
    disk = DiskConfig(footer_mb=0, flush_s=60.0)
    recorder = Recorder(run, now_ns=AnchoredClock().now_ns, config=RecorderConfig(disk=disk))
    recorder.start(INFO)
    refused = 0

    def refuse(self: object, *_: object) -> int:
        nonlocal refused
        refused += 1
        if refused <= 3:
            raise OSError(number, os.strerror(number))
        return real(self, *_)  # type: ignore[arg-type]

    from bridge.record.episode_recording import EpisodeRecording

    real = EpisodeRecording._append
    monkeypatch.setattr(
        EpisodeRecording, "_append", lambda *a: refuse(*a) if "raw" in a[2].topic else real(*a)
    )
    for index in range(40):
        recorder.receive(raw(sequence=index))
        recorder.receive(make_sample(sequence=index))
    assert recorder.failed.wait(10.0)
    recorder.close()
    path = run.episodes_dir / "t1.mcap"
    topics = ledger(path)
    found = read(path)
    said = {topic: tally["received"] + lost(tally) for topic, tally in topics.items()}
    assert sum(said.values()) == len(found) + sum(lost(t) for t in topics.values())
    assert abs(said[RAW] - said[JOINTS]) <= 1  # sent by turns: the accounts end at one instant
    assert lost(topics[RAW]) >= 1
    assert check_code(path) == 3


def test_what_a_barrier_has_not_let_through_yet_is_given_up_with_the_rest(
    make_sample: MakeSample,
) -> None:
    """Law: given up in the middle of yielding, nothing is forgotten between the two."""
    items = deque(Item(make_sample(), Step(), ticket, "", 1, is_bulk=True) for ticket in range(8))
    merge = Merge()
    merge.feed([Command(action=lambda _: None, received_ns=0, ticket=6, images_before=6)], items)
    ready = merge.ready()
    first = [next(ready), next(ready)]
    rest = merge.rest()  # as when the second one could not be written
    assert first + rest == list(items)[:6]
    assert isinstance(next(ready), Command)
    assert list(ready) == list(items)[6:]
    assert merge.images_out == 8
