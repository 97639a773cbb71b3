"""Work on several processes: a death costs one piece, a bug one answer, and nothing is lost."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import pytest
from patience import wait_until

from bridge import process_pool
from bridge.process_pool import (
    ALONE,
    ATTEMPTS,
    MOST,
    Failed,
    NoProcessError,
    ProcessPool,
    TimeIsUpError,
    Worker,
    WorkerDiedError,
    default_size,
)

KILL_ITSELF = "__import__('os').kill(__import__('os').getpid(), 9)"


def run(runner: Any, items: Sequence[str], cost: Any = len) -> dict[str, Any]:
    with runner as open_runner:
        return dict(open_runner.run(eval, items, cost))


def test_every_piece_comes_back_with_its_answer_from_another_process() -> None:
    items = [f"({k} ** 2, __import__('os').getpid())" for k in range(6)]
    answers = run(ProcessPool(2), items)
    assert [answers[item][0] for item in items] == [k**2 for k in range(6)]
    pids = {pid for _, pid in answers.values()}
    assert len(pids) <= 2
    assert os.getpid() not in pids


def test_one_process_gives_the_same_answers_in_order() -> None:
    with ALONE as runner:
        assert list(runner.run(eval, ["1 + 1", "2 + 2"], len)) == [("1 + 1", 2), ("2 + 2", 4)]


@pytest.mark.parametrize("runner", [ALONE, ProcessPool(2)])
def test_what_goes_wrong_with_one_piece_is_its_answer_and_the_others_go_on(runner: Any) -> None:
    answers = run(runner, ["1 / 0", "2 + 2", "nonsense"])
    assert answers["2 + 2"] == 4
    failed = answers["1 / 0"]
    assert isinstance(failed, Failed)
    assert failed.message == "internal error: ZeroDivisionError: division by zero"
    assert not failed.known
    assert "Traceback" in failed.trace
    assert "NameError" in answers["nonsense"].message


def test_a_disk_that_refuses_is_no_bug_and_a_missing_file_of_ours_is() -> None:
    full = "(_ for _ in ()).throw(OSError(28, 'No space left on device', '/run/derived/a.mcap'))"
    answers = run(ALONE, [f"next({full})", "open('/nowhere/at/all')"])
    refused, missing = answers[f"next({full})"], answers["open('/nowhere/at/all')"]
    assert refused.message == "the disk refuses at /run/derived/a.mcap: No space left on device"
    assert refused.known
    assert not missing.known


def test_a_killed_process_costs_only_what_it_was_doing(tmp_path: Path) -> None:
    """What dies each time is tried once more and then named; all others are answered."""
    log = tmp_path / "log"
    deadly = f"open({str(log)!r}, 'a').write('x') and {KILL_ITSELF}"
    answers = run(ProcessPool(2), [deadly, *(f"{k}" for k in range(8))])
    assert [answers[f"{k}"] for k in range(8)] == list(range(8))
    failed = answers[deadly]
    assert isinstance(failed, Failed)
    assert failed.known
    assert "ended by SIGKILL, perhaps by a machine short of memory, 2 times" in failed.message
    assert len(log.read_text()) == ATTEMPTS == 2


def test_what_died_by_accident_is_done_at_the_second_try(tmp_path: Path) -> None:
    flag = tmp_path / "was here"
    item = f"(__import__('pathlib').Path({str(flag)!r}).exists() or open({str(flag)!r}, 'x') and "
    item += f"{KILL_ITSELF}) and 'done'"
    assert run(ProcessPool(1), [item, "1"]) == {item: "done", "1": 1}


def test_a_process_killed_while_it_was_idle_is_replaced() -> None:
    with ProcessPool(1) as pool:
        ((_, pid),) = pool.run(eval, ["__import__('os').getpid()"], len)
        os.kill(pid, signal.SIGKILL)
        ends = time.monotonic() + 5
        while time.monotonic() < ends and Path(f"/proc/{pid}/cmdline").exists():
            if not Path(f"/proc/{pid}/cmdline").read_bytes():  # a zombie: dead, not yet collected
                break
            time.sleep(0.01)
        assert list(pool.run(eval, ["40 + 2"], len)) == [("40 + 2", 42)]


def test_where_the_system_gives_no_more_processes_the_others_do_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left = [Worker]

    def scarce(**_: bool) -> Worker:
        if not left:
            raise BlockingIOError(11, "Resource temporarily unavailable")
        return left.pop()()

    monkeypatch.setattr(process_pool, "Worker", scarce)
    assert run(ProcessPool(4), [f"{k}" for k in range(6)]) == {f"{k}": k for k in range(6)}
    with pytest.raises(NoProcessError, match=r"\(Resource temporarily unavailable\).*--workers 1"):
        run(ProcessPool(4), ["1"])


def test_the_longest_are_begun_first() -> None:
    with ProcessPool(1) as pool:
        order = [item for item, _ in pool.run(eval, ["1", "333", "22"], len)]
    assert order == ["333", "22", "1"]


def test_processes_have_one_thread_each_and_this_one_keeps_its_settings(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    item = "[__import__('os').environ.get(n) for n in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS')]"
    assert run(ProcessPool(1), [item]) == {item: ["1", "1"]}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_processes_end_with_their_owner_also_when_it_is_killed() -> None:
    code = (
        "import os, sys\n"
        "from bridge.process_pool import ProcessPool\n"
        "if __name__ == '__main__':\n"
        "    pool = ProcessPool(1)\n"
        "    ((_, pid),) = pool.run(eval, ['__import__(\"os\").getpid()'], len)\n"
        "    print(pid, flush=True)\n"
        "    sys.stdin.read()\n"
    )
    root = Path(__file__).parents[2]
    owner = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=root,
    )
    with owner:
        assert owner.stdout is not None
        pid = int(owner.stdout.readline())
        assert _alive(pid)
        owner.kill()
        owner.wait(10)
        wait_until(lambda: not _alive(pid))


def _alive(pid: int) -> bool:
    try:
        return bool(Path(f"/proc/{pid}/cmdline").read_bytes())
    except OSError:
        return False


def test_a_worker_that_hangs_is_noticed_and_ended() -> None:
    worker = Worker()
    worker.begin(eval, "__import__('threading').Event().wait()")  # for ever
    with pytest.raises(TimeIsUpError, match=r"no answer within 0\.05 s"):
        worker.finish(0.05)
    assert worker.busy
    pid = worker.process.pid
    worker.close()
    assert pid is not None
    assert not _alive(pid)


def test_a_worker_that_ends_says_how() -> None:
    worker = Worker()
    worker.begin(os._exit, 3)
    with pytest.raises(WorkerDiedError, match="with exit code 3"):
        worker.finish(20.0)
    worker.close()


@pytest.mark.parametrize("size", [100, 3_000_000])
def test_a_worker_that_stops_listening_is_noticed_and_ended(size: int) -> None:
    """Law: with a limit nothing waits for ever, however much of a piece was sent."""
    with closing(Worker()) as worker:
        worker.begin(len, b"")
        assert worker.finish(60.0) == 0
        os.kill(worker.process.pid, signal.SIGSTOP)
        with pytest.raises(TimeIsUpError):
            _ask(worker, bytes(size), 0.1)


def _ask(worker: Worker, item: bytes, timeout_s: float) -> None:
    worker.begin(len, item, timeout_s)
    worker.finish(timeout_s)


def test_half_an_answer_is_not_waited_for_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_pool, "PATIENCE_S", 0.1)
    with closing(Worker()) as worker:
        worker.begin(bytes, 3_000_000)
        assert wait([worker.outlet], 60)
        os.kill(worker.process.pid, signal.SIGSTOP)  # a socket holds less than that
        with pytest.raises(TimeIsUpError):
            worker.finish(60.0)


@pytest.mark.parametrize(("cores", "size"), [(1, 1), (2, 2), (64, MOST)])
def test_each_core_that_may_be_used_has_a_process_up_to_a_limit(
    monkeypatch: pytest.MonkeyPatch, cores: int, size: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert default_size() == size
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    assert default_size() == size
