"""A long replay that is killed goes on where it was."""

import os
from dataclasses import replace

import pytest

from bridge.episode import streams
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from twin.replay import runner
from twin.replay.config import ReplayConfig
from twin.replay.job import ReplayJob, row_of_existing
from twin.replay.run_job import run_job
from twin.replay.runner import there_already
from twin.replay.summary import count_verdicts, describe_run

QUICK = ReplayConfig(settle_after_s=0.3, settle_before_s=0.1)


def test_a_half_written_replay_does_not_count(jobs: list[ReplayJob]) -> None:
    path = jobs[0].path()
    path.with_name(path.name + ".part").write_bytes(b"half")
    assert row_of_existing(jobs[0]) is None
    path.write_bytes(b"torn")
    assert row_of_existing(jobs[0]) is None


def test_what_is_asked_for_last_counts_also_when_it_was_made_first(
    jobs: list[ReplayJob], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The newest replay of a trajectory is the one that an evaluation takes."""
    monkeypatch.setattr(runner, "row_of_existing", lambda job: {} if job.path().exists() else None)
    sampled = replace(jobs[0], config=replace(QUICK, samples=4))
    for age_s, job in enumerate((sampled, jobs[0], jobs[1])):
        job.path().touch()
        os.utime(job.path(), ns=(0, (10 - age_s) * 10**9))
    before = {job.path(): job.path().stat().st_mtime_ns for job in (jobs[0], jobs[1], sampled)}

    rows, todo = there_already(jobs, force=False)
    assert (rows, todo) == ([{}, {}], [jobs[2]])
    after = {path: path.stat().st_mtime_ns for path in before}
    assert after[jobs[0].path()] > after[sampled.path()] == before[sampled.path()]
    assert there_already(jobs, force=True) == ([], jobs)


def test_settings_of_samples_name_another_file(jobs: list[ReplayJob]) -> None:
    sampled = replace(jobs[0], config=replace(QUICK, samples=4))
    assert sampled.path() != jobs[0].path()
    assert sampled.cost() == 5 * jobs[0].cost()


@pytest.mark.slow
def test_what_a_killed_replay_left_is_made_again_and_whole(jobs: list[ReplayJob]) -> None:
    job = replace(jobs[0], config=replace(QUICK, samples=1))
    part = job.path().with_name(job.path().name + ".part")
    writer = EpisodeWriter(job.path())
    writer.describe(EpisodeInfo(id="trial_0001", kind="trial"))
    writer.abandon()
    assert part.is_file()
    assert row_of_existing(job) is None
    row = run_job(job)
    assert row["error"] is None
    assert not part.exists()
    again = row_of_existing(job)
    assert again is not None
    assert again["skipped"]
    assert again == {**row, "skipped": True}
    episode = Episode.open(job.path())
    ((_, verdict),) = streams.verdicts(episode)
    assert verdict.p_success == row["p_success"]
    assert verdict.p_success is not None
    assert verdict.p_success["n"] == 1
    assert "varied replays that succeed:" in describe_run(
        {"rows": [row], "counts": count_verdicts([row])}
    )
