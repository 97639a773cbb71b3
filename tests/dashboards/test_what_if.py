"""What if: limits, one job at a time, cancelled and killed ones, and the smallest change."""

import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from fake_replays import LIMIT_M, by_shift, never
from headless import CHROMIUM, NO_CHROMIUM, chromium
from other_processes import ended_within
from serving import dashboard

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from dashboards import trial_routes
from dashboards.what_if import (
    BETWEEN,
    QUANTITIES,
    BusyError,
    Question,
    WhatIfJobs,
    keep_answer,
    read_change,
)
from twin.replay.config import ChangeConfig

ID = "trial_0001"
PLAN = f"{ID}_p1"
OTHER = {"headers": {"Origin": "http://elsewhere.example"}}


@pytest.fixture
def question(tmp_path: Path) -> Question:
    return Question(
        run_path=tmp_path, episode_id=ID, plan_id="plan", change=ChangeConfig(), sweep="x_m"
    )


def ended(jobs: WhatIfJobs, question: Question) -> dict[str, Any]:
    """Wait for the job's thread, which is the only other one that works on it."""
    for thread in threading.enumerate():
        if thread.name.endswith("(_work)"):
            thread.join(60)
    return jobs.state(question.run_path, question.episode_id)


def pid_of(question: Question) -> int:
    path = question.run_path / "pid"
    limit = time.monotonic() + 60
    while not path.is_file():
        assert time.monotonic() < limit
        threading.Event().wait(0.01)
    return int(path.read_text())


def test_the_smallest_change_that_flips_the_verdict_is_narrowed_down(question: Question) -> None:
    jobs = WhatIfJobs(by_shift)
    assert jobs.start(question)["state"] == "running"
    found = ended(jobs, question)
    assert not found["busy"]
    answer = found["answers"][0]
    assert answer["state"] == "done"
    values = [each["value"] for each in answer["outcomes"]]
    assert values == sorted(values)
    assert set(QUANTITIES["x_m"].values) < set(values)
    assert len(values) == answer["total"] == len(QUANTITIES["x_m"].values) + BETWEEN
    flip = answer["flip"]
    assert flip["accepted"] is False
    assert flip["value"] <= LIMIT_M < flip["kept"]
    assert flip["kept"] - flip["value"] < 0.01 / 2**BETWEEN + 1e-9
    assert all(each["accepted"] is (each["value"] > LIMIT_M) for each in answer["outcomes"])

    weak = replace(question, sweep="grip_force", change=ChangeConfig(x_m=0.01))
    jobs.start(weak)
    jobs_found = ended(jobs, weak)
    newest, older = jobs_found["answers"]
    assert (newest["sweep"], older["sweep"]) == ("grip_force", "x_m")
    assert newest["flip"]["value"] <= 0.6 < newest["flip"]["kept"]
    jobs.start(replace(question, sweep=""))
    assert [each["value"] for each in ended(jobs, question)["answers"][0]["outcomes"]] == [None]
    assert jobs.state(question.run_path, ID, "rebuilt since")["answers"] == []
    jobs.start(question)  # asked again: replaced, not added
    assert [each["sweep"] for each in ended(jobs, question)["answers"]] == ["x_m", "", "grip_force"]


def test_an_undecided_value_flips_nothing(question: Question) -> None:
    jobs = WhatIfJobs(by_shift)
    jobs.start(replace(question, sweep="friction"))
    answer = ended(jobs, question)["answers"][0]
    assert answer["outcomes"][0]["accepted"] is None
    assert answer["flip"] is None


def test_one_job_at_a_time_and_a_cancelled_one_leaves_no_process(question: Question) -> None:
    jobs = WhatIfJobs(never)
    jobs.start(question)
    pid = pid_of(question)
    other = replace(question, episode_id="trial_0002")
    with pytest.raises(BusyError, match="a job on trial_0001 is running; wait for it or cancel"):
        jobs.start(other)
    assert jobs.state(other.run_path, other.episode_id) == {
        "busy": True,
        "current": None,
        "answers": [],
    }
    jobs.cancel()
    assert ended_within(pid, 20)
    found = ended(jobs, question)
    assert found["current"]["state"] == "cancelled"
    assert not found["busy"]


def test_a_killed_process_is_said_and_the_next_job_works(question: Question) -> None:
    jobs = WhatIfJobs(never)
    jobs.start(question)
    os.kill(pid_of(question), signal.SIGKILL)
    found = ended(jobs, question)["current"]
    assert found["state"] == "broken"
    assert "ended by SIGKILL" in found["message"]
    jobs._replay = by_shift
    jobs.start(question)
    assert ended(jobs, question)["current"]["state"] == "done"


@pytest.mark.parametrize(
    ("record", "why"),
    [
        ({"friction": 99}, "friction"),
        ({"grip_delay_s": -0.1}, "grip-delay-s"),
        ({"turn_rad": 10**400}, "turn_rad is a number"),
        ({"x_m": float("nan")}, "x_m is a number"),
        ({"mass": "2"}, "mass is a number"),
        ({"mass": True}, "mass is a number"),
        ({"gravity": 1.0}, "no quantity 'gravity'"),
        ({"object": 3}, "object is a name"),
        ([1], "object of numbers"),
    ],
)
def test_values_beyond_their_limits_are_refused(record: Any, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        read_change(record)


def test_only_a_page_of_this_server_may_ask_and_only_for_what_is_there(
    own_run: RunFolder, synthetic: ModuleType
) -> None:
    browser = synthetic.browser_of(own_run)
    address = f"/episode/{ID}/what_if"
    asked = {"plan": PLAN, "change": {}, "sweep": "x_m"}
    assert browser.post(address, json=asked, **OTHER).status_code == 403
    assert browser.post(f"{address}/cancel", json={}, **OTHER).status_code == 403
    assert (
        browser.post(address, content=b"{", headers={"Content-Type": "text/plain"}).status_code
        == 415
    )
    as_json = {"Content-Type": "application/json"}
    assert browser.post(address, content=b"{", headers=as_json).status_code == 400
    assert browser.post(address, content=b"[" * 5000, headers=as_json).status_code == 413
    for wrong in (
        {"sweep": "gravity"},
        {"plan": "another"},
        {"change": {"friction": 1e9}},
        {"more": 1},
    ):
        assert browser.post(address, json=asked | wrong).status_code == 400
    assert browser.post("/episode/nobody/what_if", json=asked).status_code == 404
    assert browser.get(address).json() == {"busy": False, "current": None, "answers": []}
    assert not (own_run.results_dir / "what_if").exists()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_the_page_shows_the_strip_and_why_a_plan_cannot_be_replayed(
    own_run: RunFolder, tmp_path: Path, synthetic: ModuleType
) -> None:
    outcomes = [{"value": v, "accepted": v > LIMIT_M, "why": "<b>", "file": ""} for v in (-0.01, 0)]
    change = {name: each.nominal for name, each in QUANTITIES.items()} | {"object": ""}
    kept = {"plan": PLAN, "change": change, "sweep": "x_m", "state": "done", "message": ""}
    flip = {"value": -0.01, "kept": 0, "accepted": False}
    question = Question(
        run_path=own_run.path, episode_id=ID, plan_id=PLAN, change=ChangeConfig(), sweep="x_m"
    )
    browser = synthetic.browser_of(own_run)
    basis = trial_routes._basis(own_run, own_run.episodes_dir / f"{ID}.mcap")
    kept |= {"basis": basis, "total": 2, "outcomes": outcomes, "flip": flip}
    keep_answer(question, kept)
    assert browser.get(f"/episode/{ID}/what_if").json()["answers"] == [kept]
    answers = "document.querySelector('.what-if .answers').textContent"
    with dashboard(own_run) as (_, url), chromium(tmp_path) as tab:
        tab.show(f"{url}episode/{ID}", width=1280, dark=False)
        tab.ask_when(f"{answers}.includes('flips the verdict to failure: \\u221210 mm')")
        assert "✗ failure" in tab.ask(answers)
        tab.ask("document.querySelector('.what-if .as-set').click()")
        tab.ask_when(f"{answers}.includes('robot description')")
        tab.ask_when("document.querySelector('.what-if').dataset.state === 'idle'")
        assert "robot description" in tab.ask(answers)  # kept
        assert not tab.complaints
