"""The gate's own process may be stopped, or fail to start, and the next plan is judged."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.process_pool import Worker, WorkerDiedError
from bridge.terminal import Output
from twin.gate import twin_process
from twin.gate.config import GateConfig
from twin.gate.gate import UndecidedError
from twin.gate.twin_process import TwinProcess


@pytest.fixture
def twin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TwinProcess]:
    """A process that imports nothing, and does what it is told instead of replaying."""
    monkeypatch.setattr(twin_process, "get_ready", id)
    with TwinProcess(tmp_path, GateConfig(), Output(quiet=True)) as process:
        yield process


def asked(twin: TwinProcess, expression: str, *, within_s: float = 20.0) -> object:
    return twin._do("replay", eval, expression, time.monotonic() + within_s)


def test_a_process_stopped_between_two_plans_holds_no_more_than_one(twin: TwinProcess) -> None:
    """A plan with frames is more than a pipe takes: it would be sent for ever."""
    assert asked(twin, "1 + 1") == 2
    assert twin._worker is not None
    os.kill(twin._worker.pid, signal.SIGSTOP)
    with pytest.raises(UndecidedError, match=r"wall-clock limit .*; it was stopped"):
        asked(twin, "1 + 1" + " " * 3_000_000, within_s=0.2)
    assert asked(twin, "2 + 2") == 4


def test_a_process_killed_while_it_is_started_is_replaced(
    twin: TwinProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts: list[Worker] = []

    class Doomed(Worker):
        """The first one is killed before it hears anything."""

        def __init__(self) -> None:
            super().__init__()
            starts.append(self)
            if len(starts) == 1:
                self.process.kill()
                self.process.wait()

    monkeypatch.setattr(twin_process, "Worker", Doomed)
    for _ in range(2):
        with pytest.raises(UndecidedError, match=r"no replay: .* by SIGKILL"):
            asked(twin, "__import__('os').kill(__import__('os').getpid(), 9)")
    assert asked(twin, "2 + 2") == 4
    with pytest.raises(WorkerDiedError):
        starts[0].begin(len, b"")
