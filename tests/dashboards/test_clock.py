"""A replay lies where its plan was executed, whichever clock its file keeps."""

from types import ModuleType

import numpy as np
import pytest

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from dashboards.recording import PageClock, Recording, read_recording


@pytest.fixture
def recording(shared_run: RunFolder) -> Recording:
    return read_recording(shared_run.episodes_dir / "trial_0001.mcap")


def test_time_on_the_page_goes_there_and_back(recording: Recording, synthetic: ModuleType) -> None:
    clock = PageClock.of(recording)
    assert clock.seconds(synthetic.EXECUTION_NS) == pytest.approx(1.0)
    assert clock.stamp_ns(clock.seconds(synthetic.EXECUTION_NS)) == synthetic.EXECUTION_NS
    assert clock.clamp(-3) == 0
    assert clock.clamp(99) == clock.end_s


def test_the_pages_zero_is_where_every_command_counts_from(recording: Recording) -> None:
    zero_ns = streams.first_stamp_ns(Episode.open(recording.path))
    assert PageClock.of(recording).zero_ns == zero_ns


def test_a_replay_from_zero_is_laid_from_the_start_of_its_execution(
    recording: Recording, shared_run: RunFolder
) -> None:
    clock = PageClock.of(recording)
    replay = read_recording(shared_run.derived("trial_0001.replay.planned.*")[0])
    t_s = clock.replay_seconds(replay, np.array([0, 2_800_000_000]))
    assert t_s == pytest.approx([1.0, 3.8])


def test_a_replay_of_a_plan_that_never_ran_has_no_place(
    recording: Recording, shared_run: RunFolder
) -> None:
    clock = PageClock.of(recording)
    other = read_recording(shared_run.derived("trial_0002.replay.planned.*")[0])
    assert clock.replay_seconds(other, np.array([0])) is None
    assert clock.of_plan_time("never", 0) is None
