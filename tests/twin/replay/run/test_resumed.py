"""A long replay that is killed goes on where it was; Ray gives the same bytes."""

import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.errors import MissingDependencyError, UsageError
from bridge.process_pool import Failed
from bridge.task.record import parse_record
from bridge.task.task_file import load_task
from twin.replay import runner, workers
from twin.replay.config import ReplayConfig
from twin.replay.job import ReplayJob
from twin.replay.job_row import row_of_existing
from twin.replay.run_job import run_job
from twin.replay.runner import there_already
from twin.replay.scene import StartState
from twin.replay.summary import count_verdicts, describe_run
from twin.replay.workers import RayClusterError, RayRunner, code_version, is_loopback

T0 = 1_700_000_000_000_000_000
QUICK = ReplayConfig(settle_after_s=0.3, settle_before_s=0.1)


@pytest.fixture
def jobs(tmp_path: Path, script: SimpleNamespace) -> list[ReplayJob]:
    """Plans that were never executed: two quick ones and one that is no plan to replay."""
    scene = script.scene()
    path = tmp_path / "trial_0001.mcap"
    plans = [script.plan(scene, plan_id=name, pace=4.0) for name in ("a", "b")]
    plans.append(replace(plans[0], id="broken", frame="world"))
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="trial_0001", kind="trial", task="cube_into_box"))
        writer.write(
            "/robot_description", string_to_cdr(scene.urdf), type_name=schema.STRING, log_time_ns=T0
        )
        for index, plan in enumerate(plans):
            writer.write(
                "/standin/plan", plan.to_json(), type_name=schema.PLAN, log_time_ns=T0 + index
            )
    derived = tmp_path / "derived"
    derived.mkdir()
    return [
        ReplayJob(
            episode_path=path,
            episode_sha256="0" * 64,
            plan_id=plan.id,
            plan_index=index,
            trajectory="planned",
            start_ns=T0,
            end_ns=None,
            task=load_task("cube_into_box"),
            start=StartState(Ts_base_object=scene.Ts_base_object),
            scene_hash=None,
            config=QUICK,
            folder=derived,
            duration_s=float(index),
        )
        for index, plan in enumerate(plans)
    ]


def contents(job: ReplayJob) -> list[tuple[str, int, bytes]]:
    return [(m.topic, m.publish_time_ns, m.data) for m in Episode.open(job.path()).messages()]


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
    assert after[jobs[1].path()] == before[jobs[1].path()], "nothing else counts for that plan"
    there_already(jobs, force=False)
    assert {path: path.stat().st_mtime_ns for path in before} == after
    assert there_already(jobs, force=True) == ([], jobs)


def test_settings_of_samples_name_another_file(jobs: list[ReplayJob]) -> None:
    sampled = replace(jobs[0], config=replace(QUICK, samples=4))
    assert sampled.path() != jobs[0].path()
    assert sampled.cost() == 5 * jobs[0].cost()


@pytest.mark.slow
def test_what_a_killed_replay_left_is_made_again_and_whole(jobs: list[ReplayJob]) -> None:
    """With its varied replays as records beside the verdict, in the same file."""
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
    (sample,) = [
        parse_record(message.data, name="sample")
        for message in episode.messages(episode.topics_of_type(schema.SAMPLE))
    ]
    assert (sample["plan_id"], sample["index"]) == ("a", 0)
    ((_, verdict),) = streams.verdicts(episode)
    assert verdict.p_success == row["p_success"]
    assert verdict.p_success is not None
    assert (verdict.p_success["k"], verdict.p_success["n"]) == (int(sample["accepted"]), 1)
    assert "varied replays that succeed:" in describe_run(
        {"rows": [row], "counts": count_verdicts([row])}
    )


def test_an_address_of_this_machine_is_one() -> None:
    assert is_loopback("127.0.0.1:6379")
    assert is_loopback("localhost:6379")
    assert is_loopback("[::1]:6379")
    assert not is_loopback("192.0.2.10:6379")
    assert not is_loopback("head.example:6379")


def test_a_cluster_without_a_token_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in (workers.MODE, workers.TOKEN, workers.TOKEN_PATH):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(UsageError, match="--ray needs the cluster's token"), RayRunner("h:1", 1):
        pass
    monkeypatch.setenv(workers.MODE, "disabled")
    with pytest.raises(UsageError, match="only speaks to a cluster with tokens"):
        RayRunner("h:1", 1).__enter__()
    assert os.environ[workers.MODE] == "disabled"


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependencyError, match=r"robot-gst\[cluster\]"):
        RayRunner("local", 1).__enter__()
    assert workers.TOKEN not in os.environ


def test_a_node_that_sees_no_files_or_runs_other_code_says_so(jobs: list[ReplayJob]) -> None:
    elsewhere = replace(jobs[0], folder=Path("/nowhere/derived"))
    answer = workers._task(run_job, elsewhere, code_version())
    assert isinstance(answer, Failed)
    assert "does not see /nowhere/derived" in answer.message
    assert "under the same path" in answer.message
    answer = workers._task(run_job, jobs[0], "0.0.0, replays 1, bullet-1")
    assert isinstance(answer, Failed)
    assert "install the same version on every node" in answer.message


SCRIPT = """
import pickle, sys
from pathlib import Path
from twin.replay.job import ReplayJob
from twin.replay.workers import RayRunner
from twin.replay.run_job import run_job
jobs = pickle.loads(Path(sys.argv[1]).read_bytes())
with RayRunner("local", 1) as runner:
    rows = [answer for _, answer in runner.run(run_job, jobs, ReplayJob.cost)]
Path(sys.argv[2]).write_bytes(pickle.dumps(rows))
import ray
assert not ray.is_initialized()
deadly = "__import__('os').kill(__import__('os').getpid(), 9)"
with RayRunner("local", 1) as runner:  # a second one of the same process
    answers = dict(runner.run(eval, [deadly, *map(str, range(8))], len))
assert [answers[str(number)] for number in range(8)] == list(range(8)), answers
assert answers[deadly].known
print(answers[deadly].message)
"""


@pytest.mark.slow
def test_a_ray_cluster_makes_the_same_files(jobs: list[ReplayJob], tmp_path: Path) -> None:
    """A real one, of this test's own, on the loopback address, with a token."""
    import pickle

    pytest.importorskip("ray")
    there = tmp_path / "there"
    there.mkdir()
    away = [replace(job, folder=there) for job in (jobs[0], jobs[2])]
    (tmp_path / "jobs").write_bytes(pickle.dumps(away))
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path / "jobs"), str(tmp_path / "rows")],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=Path(__file__).parents[4],
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Ray lost it: ")
    assert done.stdout.endswith(", 2 times\n")
    rows = {row["plan"]: row for row in pickle.loads((tmp_path / "rows").read_bytes())}
    assert set(rows) == {"a", "broken"}
    assert "in the frame 'world'" in rows["broken"]["error"]
    assert run_job(jobs[0]) == rows["a"]
    assert contents(jobs[0]) == contents(away[0])
    records = [Episode.open(job.path()).metadata_records for job in (jobs[0], away[0])]
    # The commit is asked for once in each process: it may change while the tests run.
    assert all(record.pop("software") for record in records)
    assert records[0] == records[1]


def test_nobody_at_an_address_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []

    class Ray:
        class exceptions:
            class RayError(Exception):
                pass

        @staticmethod
        def init(**options: Any) -> None:
            asked.append(options)
            raise ConnectionError("Failed to connect.\nA long story")

        @staticmethod
        def shutdown() -> None:
            pass

    monkeypatch.setitem(sys.modules, "ray", Ray)
    monkeypatch.setenv(workers.TOKEN, "x" * 32)
    monkeypatch.delenv(workers.MODE, raising=False)
    with socket.create_server(("127.0.0.1", 0)) as somebody_else:
        there = f"127.0.0.1:{somebody_else.getsockname()[1]}"
        with pytest.raises(RayClusterError, match=rf"no Ray cluster to use at {there}: Failed to"):
            RayRunner(there, 1).__enter__()
    asked.clear()
    with pytest.raises(RayClusterError, match=rf"at {there}: .*refused\. Start its head there"):
        RayRunner(there, 1).__enter__()
    assert asked == [], "Ray would try for minutes"
    for wrong in ("auto", "head.lab", "ray://head.lab", "head.lab:port", "head.lab:0"):
        with pytest.raises(UsageError, match="is not an address: give HOST:PORT"):
            RayRunner(wrong, 1).__enter__()
