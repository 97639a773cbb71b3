"""A process that is stopped at the worst instant is ended, and what it had is done without it."""

import os
import signal
from multiprocessing.connection import wait

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
        worker = pool._start()
        shared = process_pool._Shared(bytes, [LARGE])
        shared.ask(worker, 2)
        assert wait([worker.outlet], 60)
        os.kill(worker.pid, signal.SIGSTOP)
        monkeypatch.setattr(process_pool, "PATIENCE_S", 0.1)
        pool._exchange(shared)
        shared.do_one()
        assert len(shared.found[0]) == LARGE
        assert pool.workers == []
    assert worker.process.returncode == -signal.SIGKILL
