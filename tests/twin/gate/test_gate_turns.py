"""Plans that come while another is judged, and a process that is stopped or fails to start."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from gate_fakes import PLAN, accept, gate_with, raising

from bridge.process_pool import Worker, WorkerDiedError
from bridge.task.plan import Plan
from bridge.task.verdict import Verdict
from bridge.terminal import Output
from twin.gate import twin_process
from twin.gate.config import GateConfig
from twin.gate.gate import UndecidedError
from twin.gate.twin_process import TwinProcess


def test_reading_a_plan_counts_towards_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [time.monotonic()]

    def slowly(payload: bytes) -> Plan:
        now_s[0] += 0.3
        return PLAN

    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(Plan, "from_json", staticmethod(slowly))
    verdict = gate_with(deadline_s=0.2).judge(b"a plan")
    assert verdict.accepted is None
    assert "at the wall-clock limit of 0.2 s (--deadline)" in str(verdict.reason)


def test_a_replay_past_the_wall_clock_limit_is_null_and_the_next_plan_waits_for_its_turn() -> None:
    go_on = threading.Event()

    def slow(plan: Plan, *_: Any) -> Verdict:
        go_on.wait()
        return accept(plan)

    gate = gate_with(replay=slow, deadline_s=0.05)
    late = gate.judge(PLAN.to_json())  # comes while the replay still waits, or never
    assert late.accepted is None
    assert "not done at the wall-clock limit of 0.05 s (--deadline)" in str(late.reason)
    next_one = gate.judge(PLAN.to_json())
    assert next_one.accepted is None
    assert "an earlier plan was still being judged" in str(next_one.reason)
    go_on.set()


def test_more_plans_than_may_wait_are_turned_away_at_once() -> None:
    inside, go_on = threading.Semaphore(0), threading.Event()

    def slow(plan: Plan, *_: Any) -> Verdict:
        inside.release()
        go_on.wait(5)
        return accept(plan)

    gate = gate_with(replay=slow, waiting=1)
    answers: list[Verdict] = []
    threads = [
        threading.Thread(target=lambda: answers.append(gate.judge(PLAN.to_json())))
        for _ in range(2)
    ]
    threads[0].start()
    assert inside.acquire(timeout=5)
    threads[1].start()
    while gate._inside < 2:
        threading.Event().wait(0.005)
    turned_away = gate.judge(PLAN.to_json())
    assert turned_away.accepted is None
    assert "ask later" in str(turned_away.reason)
    go_on.set()
    for thread in threads:
        thread.join(5)
    assert [verdict.accepted for verdict in answers] == [True, True]


def test_no_two_replays_ever_run_side_by_side() -> None:
    """Robot models are shared and keep scratch memory; late replays go on and hold the turn."""
    counting, running, most, done = threading.Lock(), 0, 0, 0

    def slow(plan: Plan, *_: Any) -> Verdict:
        nonlocal running, most, done
        with counting:
            running += 1
            most = max(most, running)
        time.sleep(0.06)
        with counting:
            running -= 1
            done += 1
        return accept(plan)

    gate = gate_with(replay=slow, deadline_s=0.04, waiting=8)
    threads = [threading.Thread(target=gate.judge, args=(PLAN.to_json(),)) for _ in range(8)]
    for thread in threads:
        thread.start()
        time.sleep(0.02)
    for thread in threads:
        thread.join(5)
    assert gate._turn.acquire(timeout=5)
    assert done >= 2
    assert most == 1


def test_a_thread_that_cannot_be_started_does_not_block_the_next_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate = gate_with()
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", raising(RuntimeError("can't start new thread")))
        refused = gate.judge(PLAN.to_json())
    assert refused.accepted is None
    assert "no thread" in str(refused.reason)
    assert gate.judge(PLAN.to_json()).accepted is True


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
    os.kill(twin._worker.process.pid, signal.SIGSTOP)
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
