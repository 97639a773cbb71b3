"""A process that is stopped at the worst instant is ended, and what it had is done without it."""

import os
import signal
from multiprocessing.connection import wait

import pytest

from evaluator import child_process, workers
from evaluator.report.figures.beside import Beside
from evaluator.workers import Workers

LARGE = 3_000_000
"""Bytes; a pipe holds 65 536."""


def test_a_process_that_does_not_listen_is_not_sent_to_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(child_process, "PATIENCE_S", 0.1)
    second = Beside()
    os.kill(second.process.pid, signal.SIGSTOP)
    second.send(bytes(LARGE))
    assert second.take([]) is None
    assert second.process.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_a_process_stopped_in_the_middle_of_an_answer_costs_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with Workers(2) as pool:
        pool._start(1)
        (worker,) = pool.started
        assert wait([worker.outlet], 60)
        assert worker.answer() is None
        worker.ask(bytes, [LARGE], range(1))
        assert wait([worker.outlet], 60)
        os.kill(worker.process.pid, signal.SIGSTOP)
        monkeypatch.setattr(workers, "MAX_WAIT_S", 0.1)
        found = list(pool.map(bytes, [LARGE] * 3, each_s=workers.WORTH_S))
        assert [len(each) for each in found] == [LARGE] * 3
        assert pool.started == []
    assert worker.process.returncode == -signal.SIGKILL
