"""A recorder that runs for long: many episodes, and a cell in full flow."""

import os
import threading
import time

import numpy as np
import pytest
from fault_account import check_code, ledger, lost, read
from fault_cell import Child, FaultCell
from fault_messages import MIX

pytestmark = pytest.mark.slow

EPISODES = int(os.environ.get("GST_EPISODES", "60"))
WARM_UP_EPISODES = 30
SOAK_S = float(os.environ.get("GST_SOAK_S", "20"))
"""Memory goes up and down by 1 MB: over 15 s alone that is a slope of 2 MB/min."""
WARM_UP_S = float(os.environ.get("GST_WARM_UP_S", "8"))
WINDOWS = 3
MAX_MB_PER_MIN = 3.0
MAX_GROWTH_MB = 20.0


def test_many_episodes_leave_no_files_threads_or_memory(cell: FaultCell) -> None:
    """Law: what an episode took, its end gives back."""
    recorder = cell.record()
    publisher = cell.publisher()

    def record(name: str) -> None:
        assert publisher.ask("start", {"id": name, "info": {"cell": "cell"}})["ok"]["ok"]
        publisher.flow(0.0, *MIX)
        publisher.answer()
        answer = publisher.ask("stop")["ok"]
        assert (answer["messages"], answer["lost"]) == (4, 0)

    for number in range(WARM_UP_EPISODES):
        record(f"warm_{number}")
    before = recorder.open_files(), recorder.number("Threads")
    before_mb = recorder.memory_mb()
    begin_s = time.monotonic()
    for number in range(EPISODES):
        record(f"e{number:04d}")
    took_s = time.monotonic() - begin_s
    time.sleep(1.0)
    after = recorder.open_files(), recorder.number("Threads")
    after_mb = recorder.memory_mb()
    print(
        f"{EPISODES} episodes in {took_s:.0f} s: files and threads {before} -> {after}, "
        f"{before_mb:.1f} -> {after_mb:.1f} MB"
    )
    assert after[0] <= before[0] + 2
    assert after[1] <= before[1] + 2
    assert after_mb - before_mb < MAX_GROWTH_MB
    assert len(list((cell.run / "episodes").iterdir())) == EPISODES + WARM_UP_EPISODES
    for name in ("e0000", f"e{EPISODES - 1:04d}"):
        assert len(read(cell.path(name))) == 4
        assert check_code(cell.path(name)) == 0


def slope_mb_per_min(recorder: Child, publisher: Child) -> float:
    """How fast memory grows while a cell is in flow for ``SOAK_S``."""
    ended = threading.Event()

    def flow() -> None:
        publisher.flow(SOAK_S, *MIX, "raw")
        publisher.answer()
        ended.set()

    thread = threading.Thread(target=flow)
    thread.start()
    times, sizes = [], []
    while not ended.wait(0.5):
        times.append(time.monotonic() / 60.0)
        sizes.append(recorder.memory_mb())
    thread.join()
    slope = float(np.polyfit(times, sizes, 1)[0])
    print(f"{SOAK_S:g} s: {slope:+.2f} MB/min between {min(sizes):.0f} and {max(sizes):.0f} MB")
    return slope


def test_memory_does_not_grow_while_a_cell_is_recorded(cell: FaultCell) -> None:
    """Law: in one long episode, nothing is lost and memory stays what it was."""
    recorder = cell.record()
    publisher = cell.publisher()
    assert publisher.ask("start", {"id": "soak", "info": {"cell": "cell"}})["ok"]["ok"]
    publisher.flow(WARM_UP_S, *MIX, "raw")
    publisher.answer()
    # On a busy machine buffers reach their size late. That ends; a leak grows in every window.
    slope = slope_mb_per_min(recorder, publisher)
    for _ in range(WINDOWS - 1):
        if slope >= MAX_MB_PER_MIN:
            slope = slope_mb_per_min(recorder, publisher)
    # The stop follows the last message in the publisher's own queue. If it waited for this process
    # on a busy machine, the silence before it would be reported.
    publisher.flow(0.0, *MIX, "raw")
    publisher.tell(ask="stop", payload="")
    publisher.answer()
    answer = publisher.answer()["ok"]
    print(f"{answer['messages']} messages, {answer['lost']} lost")
    assert answer["messages"] == len(publisher.sent())
    assert sum(lost(tally) for tally in ledger(cell.path("soak")).values()) == 0
    assert slope < MAX_MB_PER_MIN
    assert check_code(cell.path("soak")) == 0
