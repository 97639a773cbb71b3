"""The tables of the laboratory's measurement: what counts, and against what."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))
import bench_lab_verdicts as bench  # noqa: E402
from lab_session import nominal_of  # noqa: E402


def row(said: bool | None, happened: str, p: float | None = 1.0, **more: Any) -> dict[str, Any]:
    return {
        "task": "push_cube_to_mark",
        "seed": 1,
        "start": 0,
        "part": "after",
        "said": said,
        "happened": happened,
        "p_success": p,
        "planned": True,
        "geometry": True,
        **more,
    }


ROWS = [
    row(True, "success", 0.9),
    row(True, "failure", 0.7),
    row(False, "failure", 0.2),
    row(False, "success", 0.4, seed=2),
    row(None, "success", None, seed=2),
    row(True, "unknown", seed=2),
    row(None, "failure", None, planned=False, seed=2),
]


def test_void_trials_and_those_without_plan_or_verdict_are_counted_and_left_out() -> None:
    table = bench.table(ROWS)
    counts = {key: table[key] for key in ("trials", "void", "no plan", "no verdict", "n", "yes")}
    assert counts == {
        "trials": 7, "void": 1, "no plan": 1, "no verdict": 1, "n": 4, "yes": 2
    }  # fmt: skip


def test_every_number_is_what_counting_by_hand_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "RESAMPLES", 200)
    found = bench.table(ROWS)["statistics"]
    values = {name: item["value"] for name, item in found.items()}
    assert values["base rate"] == 0.5
    assert values["accuracy"] == 0.5
    assert values["PPV"] == 0.5
    assert values["NPV"] == 0.5
    assert values["geometric rule, accuracy"] == 0.5
    assert values["Brier"] == pytest.approx((0.01 + 0.49 + 0.04 + 0.36) / 4)
    assert values["Brier, base rate minus gate"] == pytest.approx(0.25 - 0.9 / 4)
    assert found["accuracy"]["low"] <= 0.5 <= found["accuracy"]["high"]


def test_whole_sessions_are_resampled_task_by_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four trials of a session that agree are one piece of knowledge, not four."""
    monkeypatch.setattr(bench, "RESAMPLES", 500)
    together = [
        row(True, "success" if seed else "failure", seed=seed) for seed in (0, 1) for _ in range(8)
    ]
    accuracy = bench.with_intervals(together)["accuracy"]
    assert (accuracy["low"], accuracy["high"]) == (0.0, 1.0)


def test_the_forecast_without_a_twin_knows_the_first_trials_of_its_own_session_only() -> None:
    rows = [
        *(row(True, happened, part="before") for happened in ("success", "failure", "failure")),
        row(True, "unknown", part="before"),
        row(True, "success", part="before", seed=2),
        row(True, "failure"),
    ]
    bench.with_first_trials(rows)
    assert rows[-1]["again"] == pytest.approx((1 + 1) / (3 + 2))
    assert all("again" not in other for other in rows[:-1])
    assert np.isnan(bench.arrays(rows)["again"][0])


def test_what_the_samples_took_away_is_given_back_to_the_nominal_replay() -> None:
    refused = {"accepted": False, "terminal": {"cause": "probability"}}
    assert nominal_of(refused) is True
    assert nominal_of({"accepted": False, "terminal": {"cause": "inside"}}) is False
    assert nominal_of({"accepted": None, "terminal": {"cause": None}}) is None
    assert nominal_of(None) is None


def test_the_targets_of_the_protocol_are_asked_for_and_no_number_misses_them() -> None:
    tables = {"pooled": bench.table(ROWS), "push_cube_to_mark": bench.table(ROWS)}
    targets = {target.what: target for target in bench.targets_of("x", tables)}
    assert targets["x: PPV"].limit == 0.85
    assert targets["x: good plans accepted"].limit == 0.80
    assert targets["x: Brier"].at_most
    nothing = bench.targets_of("x", {"pooled": bench.table(ROWS[4:5] + ROWS[:1])})
    assert not next(t for t in nothing if t.what.endswith("rule")).met


def test_tasks_take_turns_and_no_seed_was_used_before() -> None:
    asked = bench.arguments([])
    sessions = bench.sessions_of(asked)
    assert [s.task for s in sessions[:5]] == list(bench.TASKS)
    assert sorted(s.seed for s in sessions) == list(range(8100, 8150))
    development = bench.sessions_of(bench.arguments(["--development", "1000300"]))
    assert {s.seed for s in development} == set(range(1000300, 1000310))
