"""Ray gives the same bytes as processes; one that lets anybody in, or is empty, is refused."""

import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import pytest

from bridge.episode.reader import Episode
from bridge.errors import MissingDependencyError, UsageError
from bridge.process_pool import Failed
from twin import ray_cluster
from twin.ray_cluster import RayClusterError, RayRunner, code_version
from twin.replay.job import ReplayJob
from twin.replay.run_job import run_job


def contents(job: ReplayJob) -> list[tuple[str, int, bytes]]:
    return [(m.topic, m.publish_time_ns, m.data) for m in Episode.open(job.path()).messages()]


def test_a_cluster_without_a_token_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in (ray_cluster.MODE, ray_cluster.TOKEN, ray_cluster.TOKEN_PATH):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(UsageError, match="--ray needs the cluster's token"), RayRunner("h:1"):
        pass
    monkeypatch.setenv(ray_cluster.MODE, "disabled")
    with pytest.raises(UsageError, match="only speaks to a cluster with tokens"):
        RayRunner("h:1").__enter__()
    assert os.environ[ray_cluster.MODE] == "disabled"


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setenv(ray_cluster.TOKEN, "x" * 32)
    missing = pytest.raises(MissingDependencyError, match=r"robot-gst\[cluster\]")
    with socket.create_server(("127.0.0.1", 0)) as head, missing:
        RayRunner(f"127.0.0.1:{head.getsockname()[1]}").__enter__()


def test_a_node_that_sees_no_files_or_runs_other_code_says_so(jobs: list[ReplayJob]) -> None:
    elsewhere = replace(jobs[0], folder=Path("/nowhere/derived"))
    answer = ray_cluster._task(run_job, elsewhere, code_version())
    assert isinstance(answer, Failed)
    assert "does not see /nowhere/derived" in answer.message
    assert "under the same path" in answer.message
    answer = ray_cluster._task(run_job, jobs[0], "0.0.0, replays 1, bullet-1")
    assert isinstance(answer, Failed)
    assert "install the same version on every node" in answer.message


SCRIPT = """
import pickle, sys
from pathlib import Path
from twin.replay.job import ReplayJob
from twin.ray_cluster import RayRunner
from twin.replay.run_job import run_job
jobs = pickle.loads(Path(sys.argv[1]).read_bytes())
with RayRunner(sys.argv[3]) as runner:
    rows = [answer for _, answer in runner.run(run_job, jobs, ReplayJob.cost)]
Path(sys.argv[2]).write_bytes(pickle.dumps(rows))
import ray
assert not ray.is_initialized()
deadly = "__import__('os').kill(__import__('os').getpid(), 9)"
with RayRunner(sys.argv[3]) as runner:  # a second one of the same process
    answers = dict(runner.run(eval, [deadly, *map(str, range(8))], len))
assert [answers[str(number)] for number in range(8)] == list(range(8)), answers
assert answers[deadly].known
print(answers[deadly].message)
"""


HEAD = """
import ray, sys
ray.init(num_cpus=1, include_dashboard=False, _node_ip_address="127.0.0.1", _temp_dir=sys.argv[1])
print(ray.get_runtime_context().gcs_address, flush=True)
sys.stdin.read()
"""


@contextmanager
def cluster() -> Iterator[tuple[str, dict[str, str]]]:
    """A Ray cluster of its own on the loopback address: where, and the token."""
    token = {ray_cluster.MODE: "token", ray_cluster.TOKEN: secrets.token_hex(32)}
    known = {**os.environ, **token, "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    with (
        TemporaryDirectory(prefix="gst-ray-", ignore_cleanup_errors=True) as folder,
        subprocess.Popen(
            [sys.executable, "-c", HEAD, folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=known,
        ) as head,
    ):
        assert head.stdout is not None
        yield head.stdout.readline().strip(), known
        head.communicate(timeout=60)


@pytest.mark.slow
def test_a_ray_cluster_makes_the_same_files(jobs: list[ReplayJob], tmp_path: Path) -> None:
    """A real one, of this test's own, on the loopback address, with a token."""
    import pickle

    pytest.importorskip("ray")
    there = tmp_path / "there"
    there.mkdir()
    away = [replace(job, folder=there) for job in (jobs[0], jobs[2])]
    (tmp_path / "jobs").write_bytes(pickle.dumps(away))
    with cluster() as (address, known):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(tmp_path / "jobs"), str(tmp_path / "rows"), address],
            capture_output=True,
            text=True,
            timeout=240,
            cwd=Path(__file__).parents[4],
            check=False,
            env=known,
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
    monkeypatch.setenv(ray_cluster.TOKEN, "x" * 32)
    monkeypatch.setenv(ray_cluster.MODE, "token")
    with socket.create_server(("127.0.0.1", 0)) as somebody_else:
        there = f"127.0.0.1:{somebody_else.getsockname()[1]}"
        with pytest.raises(RayClusterError, match=rf"no Ray cluster to use at {there}: Failed to"):
            RayRunner(there).__enter__()
    asked.clear()
    with pytest.raises(RayClusterError, match=rf"at {there}: .*refused\. Start its head there"):
        RayRunner(there).__enter__()
    assert asked == [], "Ray would try for minutes"
    for wrong in ("auto", "local", "head.lab", "ray://head.lab", "head.lab:port", "head.lab:0"):
        with pytest.raises(UsageError, match="is not an address: give HOST:PORT"):
            RayRunner(wrong).__enter__()


def runner(monkeypatch: pytest.MonkeyPatch, cpus: list[float]) -> RayRunner:
    """One whose cluster has so many processors at each look, and is done after the last."""
    monkeypatch.setattr(ray_cluster, "code_version", lambda: "same")
    looks = iter(cpus)

    def wait(running: list[str], **_: Any) -> tuple[list[str], list[str]]:
        return (running[:1], []) if made._ray.over else ([], running)

    def resources() -> dict[str, float]:
        found = next(looks, None)
        made._ray.over = found is None
        return {"CPU": found} if found else {}

    made = RayRunner("head.lab:6379")
    task = SimpleNamespace(remote=lambda _, item, __: item)
    made._ray = SimpleNamespace(
        remote=lambda **_: lambda _: task,
        wait=wait,
        get=lambda reference: reference,
        cluster_resources=resources,
        exceptions=SimpleNamespace(RayError=RuntimeError),
        over=False,
    )
    return made


def test_a_cluster_that_has_no_processor_for_minutes_ends_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    empty = runner(monkeypatch, [1.0] + [0.0] * 100)
    with pytest.raises(RayClusterError, match=r"at head\.lab:6379 has had no processor for 5 min"):
        list(empty.run(eval, ["1 + 1"], len))


def test_a_cluster_whose_nodes_come_late_or_come_back_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow = runner(monkeypatch, [0.0] * 4 + [2.0] * 20 + [0.0] * 4 + [2.0])
    assert [item for item, _ in slow.run(eval, ["1 + 1"], len)] == ["1 + 1"]
