"""Before and beside: pre-roll, clock steps."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from patience import wait_until

from bridge.clock import AnchoredClock, StepWatch
from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import events
from bridge.episode.topics import DROPS
from bridge.record.config import RecorderConfig
from bridge.record.recorder import Recorder
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]
MakeRecorder = Callable[..., Recorder]
JOINTS = "/cell/joint_states"


@pytest.fixture
def make_recorder(run: RunFolder) -> Iterator[MakeRecorder]:
    made: list[Recorder] = []

    def make(*, wall_ns: Callable[[], int] = time.time_ns, **settings: object) -> Recorder:
        clock = AnchoredClock()
        config = RecorderConfig(**settings)  # type: ignore[arg-type]
        made.append(Recorder(run, now_ns=clock.now_ns, config=config, wall_ns=wall_ns))
        return made[-1]

    yield make
    for recorder in made:
        recorder.close()


def episode_of(run: RunFolder, name: str = "t1") -> Episode:
    return Episode.open(run.episodes_dir / f"{name}.mcap")


def data_of(episode: Episode, topic: str = JOINTS) -> list[bytes]:
    return [message.data for message in episode.messages([topic])]


def info(name: str = "t1") -> EpisodeInfo:
    return EpisodeInfo(id=name, kind="trial", cell="cell")


def test_the_preroll_opens_the_episode_and_its_losses_are_counted(
    make_recorder: MakeRecorder, run: RunFolder, make_sample: MakeSample
) -> None:
    recorder = make_recorder(preroll_s=30.0)
    before = [make_sample(sequence=number) for number in (0, 1, 4, 2)]
    for sample in before:
        recorder.receive(sample)
    answer = recorder.start(info())
    assert 0 < answer["preroll_s"] < 30
    after = make_sample(sequence=6)
    recorder.receive(after)
    stopped = recorder.stop()
    assert (stopped["messages"], stopped["lost"]) == (5, 2)  # 3 and 5; 2 only came late
    episode = episode_of(run)
    assert data_of(episode) == [sample.data for sample in (*before, after)]
    assert episode.start_ns <= before[0].received_ns


def test_the_preroll_reaches_back_as_far_as_asked_and_no_further(
    make_recorder: MakeRecorder, run: RunFolder, make_sample: MakeSample
) -> None:
    recorder = make_recorder(preroll_s=5.0)
    now_ns = make_sample().received_ns
    old = make_sample(received_ns=now_ns - 6 * 10**9)
    urdf = make_sample(
        topic="/robot_description",
        type_name=schema.STRING,
        data=b"urdf",
        received_ns=now_ns - 9 * 10**9,
    )
    young = make_sample(received_ns=now_ns - 4 * 10**9)
    for sample in (urdf, old, young):
        recorder.receive(sample)
    recorder.start(info())
    recorder.stop()
    assert data_of(episode_of(run)) == [young.data]
    assert data_of(episode_of(run), "/robot_description") == [b"urdf"]  # kept apart


def test_the_preroll_is_bounded_in_bytes(
    make_recorder: MakeRecorder, run: RunFolder, make_sample: MakeSample
) -> None:
    recorder = make_recorder(preroll_s=60.0, preroll_mb=1)
    for number in range(40):
        recorder.receive(make_sample(data=bytes([number]) * 100_000, type_name="x"))
    recorder.start(info())
    assert recorder.stop()["messages"] == 1_000_000 // 100_512


def test_a_step_of_the_system_clock_is_written_down_and_reorders_nothing(
    make_recorder: MakeRecorder, run: RunFolder, make_sample: MakeSample
) -> None:
    shift_ns = 0
    recorder = make_recorder(wall_ns=lambda: time.time_ns() + shift_ns)
    recorder.start(info())
    for count, step_ns in enumerate((3_600 * 10**9, -2 * 3_600 * 10**9), start=1):
        recorder.receive(make_sample())
        shift_ns += step_ns
        wait_until(lambda count=count: recorder.status()["clock_steps"] == count)
    recorder.receive(make_sample())
    recorder.stop()
    episode = episode_of(run)
    found = [event["data"]["step_ns"] for event in events(episode)]
    assert [round(step / 1e9) for step in found] == [3_600, -7_200]
    assert episode.metadata_records["recorder"]["clock_steps_ns"] == found
    times = [message.log_time_ns for message in episode.messages([JOINTS])]
    assert times == sorted(times)
    assert times[-1] - times[0] < 60 * 10**9


def test_trimming_a_clock_and_a_stopped_process_are_no_steps() -> None:
    now_ns, wall_ns = 0, 10**18

    def slow_now() -> int:  # a process stopped between two readings
        nonlocal now_ns
        now_ns += stopped_ns
        return now_ns

    stopped_ns = 0
    watch = StepWatch(slow_now, wall_ns=lambda: wall_ns)
    for _ in range(10):
        now_ns += 10**9
        wall_ns += 10**9 + 500_000  # 500 ppm fast
        assert watch.step_ns() == 0
    stopped_ns = 5 * 10**9
    assert watch.step_ns() == 0


def test_ledger_records_say_how_things_stood(
    make_recorder: MakeRecorder, run: RunFolder, make_sample: MakeSample
) -> None:
    recorder = make_recorder()
    recorder.start(info())
    for delay_ns in (5_000_000, 3_000_000, 9_000_000):
        sample = make_sample()
        recorder.receive(replace(sample, source_ns=sample.received_ns - delay_ns))
    recorder.stop()
    records = [json.loads(data) for data in data_of(episode_of(run), DROPS)]
    mine = [record for record in records if record["topic"] == JOINTS]
    assert min(record["clock_offset_ns"] for record in mine) == 3_000_000
    for record in mine:
        assert record["disk_free_bytes"] > 0
        assert record["queue_bytes"] >= 0
    assert episode_of(run).metadata_records["drops"]["clock_offset_ns"] == 3_000_000
