"""A process that is stopped at the worst instant is ended, and what it had is done without it."""

import os
import signal
from collections.abc import Callable
from multiprocessing.connection import wait
from typing import Any

import pytest

from bridge import process_pool
from bridge.process_pool import ProcessPool, Worker, WorkerLostError

LARGE = 3_000_000
"""Bytes; a pipe holds 65 536."""


def test_a_process_that_does_not_listen_is_not_sent_to_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(process_pool, "PATIENCE_S", 0.1)
    second = Worker(quiet=True)
    os.kill(second.process.pid, signal.SIGSTOP)
    with pytest.raises(WorkerLostError):
        second.begin(bytes, bytes(LARGE))
    second.close()
    assert second.process.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_a_process_stopped_in_the_middle_of_an_answer_costs_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with ProcessPool(1) as pool:
        pool._start()
        answers = pool.map(bytes, [LARGE], each_s=process_pool.WORTH_S)
        monkeypatch.setattr(process_pool, "wait", stopping(pool))
        monkeypatch.setattr(process_pool, "PATIENCE_S", 0.1)
        (answer,) = answers
        assert len(answer) == LARGE
        assert pool.workers == []


def stopping(pool: ProcessPool) -> Callable[..., list[Any]]:
    """Stop each process as soon as it has begun to answer."""

    def wait_and_stop(outlets: Any, timeout_s: float | None = None) -> list[Any]:
        found = wait(outlets, timeout_s)
        for worker in pool.workers:
            os.kill(worker.pid, signal.SIGSTOP)
        return found

    return wait_and_stop
