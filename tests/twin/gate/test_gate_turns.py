"""Plans that come while another is judged: limits, turns, and how many may wait."""

import threading
import time
from typing import Any

import pytest
from gate_fakes import PLAN, accept, gate_with, raising

from bridge.task.plan import Plan
from bridge.task.verdict import Verdict


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
