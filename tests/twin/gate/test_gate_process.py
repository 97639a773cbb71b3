"""The gate's own process may be stopped, or fail to start, and the next plan is judged."""

import os
import signal
import threading
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


FOREVER = "__import__('threading').Event().wait()"
"""A replay that never ends: a test that waited for it would hang, and be named by the limit."""


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


def test_a_replay_that_hangs_is_stopped_and_the_next_one_is_judged(twin: TwinProcess) -> None:
    assert asked(twin, "1 + 1") == 2
    with pytest.raises(UndecidedError, match="the replay was not done before the wall-clock limit"):
        asked(twin, FOREVER, within_s=0.1)
    assert asked(twin, "2 + 2") == 4


def test_a_replay_that_raises_is_no_verdict_with_its_sentence(twin: TwinProcess) -> None:
    raising = "(_ for _ in ()).throw(__import__('twin.errors').errors.TwinError('no waypoints'))"
    with pytest.raises(UndecidedError, match=r"^no waypoints$"):
        asked(twin, raising)
    with pytest.raises(UndecidedError, match="internal error: ZeroDivisionError"):
        asked(twin, "1 / 0")


def test_a_gate_that_is_being_stopped_says_so(twin: TwinProcess) -> None:
    said: list[Exception] = []

    def ask() -> None:
        try:
            asked(twin, FOREVER, within_s=60)
        except UndecidedError as error:
            said.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    while twin._worker is None or not twin._worker.busy:
        threading.Event().wait(0.005)
    twin.close()
    asking.join(10)
    assert not asking.is_alive()
    assert len(said) == 1
    with pytest.raises(UndecidedError, match="is being stopped"):
        asked(twin, "1", within_s=1)
