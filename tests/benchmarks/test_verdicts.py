"""The benchmark's own judge: it must see what is missing, altered, doubled or made up."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.writer import EpisodeWriter

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
cell = pytest.importorskip("record.cell")
verify = pytest.importorskip("record.verify")

TOPIC = "/bench/joint_states"
NUM_SENT = 10


def judge(folder: Path, numbers: list[int], *, altered: int = -1, declared: int = 0) -> object:
    """The verdict over an episode that holds these messages of the ten that were sent."""
    spec = cell.CellSpec(streams="joints")
    streams = {stream.topic: stream for stream in cell.streams_of(spec)}
    stamps = np.arange(NUM_SENT) * 2_000_000
    columns = {}
    for topic in streams:
        sent = stamps if topic == TOPIC else stamps[:0]
        columns |= {f"stamps_ns:{topic}": sent, f"put_ns:{topic}": sent, f"skipped:{topic}": 2}
    np.savez(folder / "account.npz", **columns)
    with EpisodeWriter(folder / "e.mcap") as writer:
        writer.describe(EpisodeInfo(id="e", kind="trial"))
        for number in numbers:
            stamp_ns = int(stamps[number % NUM_SENT]) + (number == altered)
            data = bytes(streams[TOPIC].message(number, stamp_ns))
            writer.write(
                TOPIC, data, type_name=schema.JOINT_STATE, log_time_ns=stamp_ns, sequence=number
            )
        counts = {TOPIC: {"gaps": declared, "queue_drops": 0, "shed": 0}}
        writer.add_metadata("drops", {"topics": json.dumps(counts)})
    found = verify.verify([folder / "e.mcap"], folder / "account.npz", spec)
    return found[TOPIC]


def test_a_whole_recording_is_exact(tmp_path: Path) -> None:
    found = judge(tmp_path, list(range(10)))
    assert (found.wanted, found.sent, found.kept, found.lost) == (12, 10, 10, 0)
    assert found.is_exact


@pytest.mark.parametrize(("declared", "is_exact"), [(0, False), (1, False), (2, True), (3, False)])
def test_losses_must_be_declared_to_the_message(
    tmp_path: Path, declared: int, is_exact: bool
) -> None:
    found = judge(tmp_path, [0, 1, 2, 4, 5, 6, 7, 8], declared=declared)
    assert (found.lost, found.is_exact) == (2, is_exact)


def test_an_altered_message_is_seen(tmp_path: Path) -> None:
    found = judge(tmp_path, list(range(10)), altered=4)
    assert (found.unequal, found.is_exact) == (1, False)


def test_a_doubled_and_an_invented_message_are_seen(tmp_path: Path) -> None:
    found = judge(tmp_path, [*range(10), 3, 12])
    assert (found.repeated, found.unsent, found.is_exact) == (1, 1, False)
