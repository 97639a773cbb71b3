"""Other processes read and compare too, and nothing in the results tells."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
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


def begun(pool: ProcessPool, number: int) -> ProcessPool:
    """Start processes."""
    while len(pool.workers) < number:
        pool._start()
    return pool


@pytest.fixture(scope="module")
def pool() -> Iterator[ProcessPool]:
    with evaluation_pool(2) as pool:
        yield pool


@pytest.fixture
def two(pool: ProcessPool) -> ProcessPool:
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
