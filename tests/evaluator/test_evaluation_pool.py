"""Other processes read and compare too, and nothing in the results tells."""

import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from other_processes import check_an_interrupted_evaluation

from bridge import process_pool
from bridge.process_pool import ProcessPool, Worker
from bridge.terminal import Output
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare import compare_run, run
from evaluator.compare.summaries import evaluation_pool
from evaluator.result import write_results
from evaluator.run_reader.contents import READ_S

ROOT = Path(__file__).resolve().parents[2]


def begun(pool: ProcessPool, number: int) -> ProcessPool:
    """Start processes, and wait until they can work."""
    while len(pool.workers) < number:
        pool._start()
    for worker in pool.workers:
        assert worker not in pool._preparing or wait([worker.outlet], 30)
    return pool


@pytest.fixture(scope="module")
def jobs() -> Iterator[ModuleType]:
    sys.path.insert(0, str(Path(__file__).parent))
    import worker_jobs

    yield worker_jobs
    sys.path.remove(str(Path(__file__).parent))


@pytest.fixture(scope="module")
def pool(jobs: ModuleType) -> Iterator[ProcessPool]:
    with evaluation_pool(2) as pool:
        yield pool


@pytest.fixture
def two(pool: ProcessPool) -> ProcessPool:
    """Two processes beside this one."""
    return begun(pool, 2)


@pytest.fixture
def nobody(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Count processes instead of starting them."""
    started: list[bool] = []

    def refuse(**_: bool) -> None:
        started.append(True)
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(process_pool, "Worker", refuse)
    return started


@pytest.mark.slow
def test_two_processes_share_a_list_and_keep_its_order(two: ProcessPool, jobs: ModuleType) -> None:
    found = list(two.map(jobs.where, range(300), each_s=0.02))
    assert [number for number, _ in found] == list(range(300))
    assert {pid for _, pid in found} == {worker.process.pid for worker in two.workers}
    again = list(two.map(jobs.surroundings, range(300), each_s=0.02))
    assert {about[1:] for about in again} == {(False, "1")}


@pytest.mark.slow
def test_what_would_be_printed_is_told_here(two: ProcessPool, jobs: ModuleType) -> None:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert list(two.map(jobs.warn, range(30), each_s=0.2)) == list(range(30))
    assert sorted(int(str(each.message).split()[1]) for each in said) == list(range(30))


def spoil(folder: Path, derived: Path) -> None:
    """Break one recorded and one derived episode, each in its own way."""
    path = folder / "a1.mcap"
    path.write_bytes(path.read_bytes()[:-40])
    derived.write_bytes(b"\x89MCAP0\r\n" * 50)


@pytest.mark.slow
def test_results_are_the_same_bytes_with_and_without_processes(
    two: ProcessPool, six_trials: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil(six_trials.run.episodes_dir, six_trials.run.derived("b1.replay.planned*")[0])
    taken: list[object] = []
    after: list[Callable[[], object]] = []
    finish = Worker.finish

    def noting(self: Worker, timeout_s: float | None = None) -> object:
        answer = finish(self, timeout_s)
        if isinstance(answer, list):
            taken.append(answer)
            for act in after:
                act()
        return answer

    def results(name: str) -> bytes:
        with SummaryCache(tmp_path / name / FOLDER) as cache:
            comparison = compare_run(six_trials.run, cache=cache)
        named = {each.episode for each in comparison.exclusions if each.scope == "everything"}
        assert "a1.mcap" in named
        return write_results(comparison.results(), tmp_path / name / "results.json").read_bytes()

    monkeypatch.setattr(Worker, "finish", noting)
    alone = results("alone")
    assert taken == []
    monkeypatch.setattr(process_pool, "WORTH_S", 1e-3)
    monkeypatch.setattr(run, "evaluation_pool", lambda: nullcontext(two))
    assert results("two") == alone
    assert len(taken) > 2
    after.append(two.workers[0].process.kill)
    assert results("killed") == alone


@pytest.mark.slow
def test_a_process_that_dies_or_hangs_costs_nothing(
    jobs: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process_pool, "PATIENCE_S", 0.3)
    with begun(evaluation_pool(2), 2) as pool:
        processes = [worker.process for worker in pool.workers]
        processes[0].send_signal(signal.SIGSTOP)
        work = partial(jobs.signal_elsewhere, os.getpid(), signal.SIGKILL)  # the other one
        assert list(pool.map(work, range(3), each_s=1.0)) == list(range(3))
        assert pool.workers == []
    assert [process.returncode for process in processes] == [-signal.SIGKILL] * 2


@pytest.mark.slow
def test_an_exception_nobody_expected_is_raised_here(two: ProcessPool, jobs: ModuleType) -> None:
    found = []
    with pytest.raises(LookupError, match="item 37") as caught:
        found.extend(two.map(jobs.fail, range(100), each_s=0.05))
    assert any(entry.name == "fail" for entry in caught.traceback)
    assert found == list(range(37))


INTERRUPTED = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in a background
import robot_gst
from bridge import process_pool
from evaluator.compare import summaries

class Told(process_pool.Worker):
    def __init__(self, **settings):
        super().__init__(**settings)
        print(self.process.pid, flush=True)

    def finish(self, timeout_s=None):
        print("reading", flush=True)
        time.sleep(20)

process_pool.WORTH_S, process_pool.Worker = 1e-3, Told
summaries.cores = lambda: 2
sys.exit(robot_gst.run(["evaluate", sys.argv[1]]))
"""


@pytest.mark.slow
def test_an_interrupt_ends_all_processes(six_trials: Any) -> None:
    check_an_interrupted_evaluation(INTERRUPTED, six_trials.run.path, "reading")


def test_few_files_start_nothing(six_trials: Any, nobody: list[bool]) -> None:
    with SummaryCache(six_trials.run.results_dir / FOLDER) as cache:
        compare_run(six_trials.run, cache=cache, output=Output(quiet=True))
    assert nobody == []
    enough = round(process_pool.WORTH_S / READ_S)
    assert list(evaluation_pool(2).map(abs, range(enough - 1), each_s=READ_S)) == list(
        range(enough - 1)
    )
    assert nobody == []
    assert list(evaluation_pool(1).map(abs, range(enough), each_s=READ_S)) == list(range(enough))
    assert nobody == []


def test_without_a_further_process_all_is_done_here(nobody: list[bool]) -> None:
    pool = evaluation_pool(2)
    assert list(pool.map(abs, range(9), each_s=process_pool.WORTH_S)) == list(range(9))
    assert nobody == [True]
