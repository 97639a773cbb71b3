"""The laboratory's areas under the curve and their intervals, by rank sums and the delta method."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
bench_lab = pytest.importorskip("bench_lab")

PLANS = 12


def laboratory(rng: np.random.Generator, num_sessions: int) -> list[dict[str, Any]]:
    """Sessions in which a forecast knows something, in steps of a quarter; some end all alike."""
    sessions = []
    for number in range(num_sessions):
        good = rng.random(PLANS) < rng.choice([0.0, 0.3, 0.5, 0.7, 1.0])
        said = np.round(4 * (0.7 * rng.random(PLANS) + 0.3 * good)) / 4
        rows = [
            {"success": bool(end), "rule": True, "own engine": p > 0.5}
            | {part: {"p": float(p)} for part in bench_lab.PARTS}
            for end, p in zip(good, said, strict=True)
        ]
        task = bench_lab.TASKS[number % len(bench_lab.TASKS)]
        sessions.append({"task": task, "first": [True, False], "rows": rows})
    return sessions


def rank_sums(sessions: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Mann and Whitney's U of each session, and its number of pairs."""
    found = []
    for each in sessions:
        good = [row["one"]["p"] for row in each["rows"] if row["success"]]
        bad = [row["one"]["p"] for row in each["rows"] if not row["success"]]
        u = mannwhitneyu(good, bad).statistic if good and bad else 0.0
        found.append((u, len(good) * len(bad)))
    u, pairs = np.transpose(found)
    return u, pairs


@pytest.mark.parametrize("seed", range(5))
def test_auc_within_sessions_is_their_rank_sums_over_their_pairs(seed: int) -> None:
    sessions = laboratory(np.random.default_rng(seed), 20)
    found = bench_lab.statistics(bench_lab.columns(sessions), np.arange(20))
    u, pairs = rank_sums(sessions)
    assert found["AUC one"] == pytest.approx(u.sum() / pairs.sum(), abs=1e-12)
    assert found["AUC rule"] == found["AUC base rate"] == found["AUC first four"] == 0.5


def test_the_interval_is_as_wide_as_sessions_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_lab, "RESAMPLES", 500)
    sessions = laboratory(np.random.default_rng(0), 48)
    found = bench_lab.with_intervals(sessions)["AUC one"]
    u, pairs = rank_sums(sessions)
    auc = u.sum() / pairs.sum()
    off = (u - auc * pairs) / pairs.sum()  # of the ratio, to first order
    tasks = np.array([each["task"] for each in sessions])
    parts = [off[tasks == task] for task in bench_lab.TASKS]
    deviation = np.sqrt(sum(len(part) * part.var() for part in parts))
    ends = [(found[end] - auc) / deviation for end in ("low", "high")]
    assert ends == pytest.approx([-1.96, 1.96], abs=0.33)
