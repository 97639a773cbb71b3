"""Agreement of varied replays: their rates, and what is not decided by them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bridge.task.verdict import Factor, Verdict
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import rate_groups, side_rates
from evaluator.compare.varied_agreement import (
    varied_agreement,
)
from evaluator.result import Measurement
from evaluator.run_reader.episodes import summarise_verdict

TASKS = ("stack", "slippery", "heavy", "beside", "into", "on", "push", "sort")
POLICIES = ("careful",)
Share = Callable[[np.random.Generator, float], float]


def rows_of(
    rates: dict[tuple[str, str], float],
    *,
    share: Share,
    nominal: bool | None = True,
    trials: int = 10,
    seed: int = 0,
) -> list[TrialRow]:
    """Trials whose outcomes and shares come from one rate for each group."""
    rng = np.random.default_rng(seed)
    return [
        TrialRow(
            episode=f"{task}_{policy}_{number}",
            task=task,
            condition="without_replanning",
            policy=policy,
            start_id=f"{task}/{number}",
            cell="standin",
            stand_in=True,
            recorded=bool(rng.random() < rate),
            sim_planned=nominal,
            sim_varied=share(rng, rate),
        )
        for (task, policy), rate in rates.items()
        for number in range(trials)
    ]


def spread_rates() -> dict[tuple[str, str], float]:
    values = np.linspace(0.1, 0.9, len(TASKS) * len(POLICIES))
    keys = [(task, policy) for task in TASKS for policy in POLICIES]
    return dict(zip(keys, values.tolist(), strict=True))


def eighths(rng: np.random.Generator, rate: float) -> float:
    return int(rng.binomial(8, rate)) / 8


def found(rows: list[TrialRow]) -> dict[str, Measurement]:
    groups = rate_groups(rows, side_rates(rows))
    return {each.id: each for each in varied_agreement(rows, groups)}


def test_shares_tell_what_a_nominal_replay_that_says_the_same_of_each_cannot() -> None:
    rows = rows_of(spread_rates(), share=eighths)
    results = compare_rows(rows, run="r", source="trials", stand_in=True).results()
    assert results.get("agreement.pearson_r").value is None, "every nominal replay says yes"
    varied = results.get("agreement.varied.pearson_r")
    by_group: dict[tuple[str, str], list[TrialRow]] = {}
    for row in rows:
        by_group.setdefault((row.task, row.policy), []).append(row)
    means = [
        (np.mean([row.recorded is True for row in mine]), np.mean([row.sim_varied for row in mine]))
        for mine in by_group.values()
    ]
    reference = np.corrcoef(np.array(means, dtype=np.float64).T)[0, 1]
    assert varied.value == pytest.approx(reference)
    assert varied.n == len(by_group)
    assert varied.interval is None
    assert varied.reason_without_interval == "shares of trials are no counts"
    gap = 100 * float(np.mean([sim - recorded for recorded, sim in means]))
    assert results.get("agreement.varied.bias_pp").value == pytest.approx(gap)
    assert results.get("agreement.varied.mmrv_recorded_gap").value is not None


def test_a_twin_that_is_wrong_the_other_way_round_has_a_negative_r() -> None:
    rows = rows_of(spread_rates(), share=lambda rng, rate: 1.0 - rate)
    varied = found(rows)["agreement.varied.pearson_r"]
    assert varied.value is not None
    assert varied.value < -0.8


def test_without_varied_replays_in_two_groups_nothing_is_said() -> None:
    rows = rows_of(spread_rates(), share=eighths)
    none = [replace(row, sim_varied=None) for row in rows]
    assert found(none) == {}
    assert found([*none[10:], *rows[:10]]) == {}
    unlabelled = [replace(row, recorded=None) for row in rows]
    assert found(unlabelled) == {}


def test_how_far_answers_are_trusted_does_not_change_how_many_succeed() -> None:
    """After ``calibrate --posterior`` the stated probability is less than the share."""
    yes = Factor(value=True)
    verdict = Verdict(
        plan_id="p",
        trajectory="planned",
        mode="dynamic",
        ik=yes,
        clearance=yes,
        terminal=yes,
        engine="fake",
        seed=0,
        p_success={"value": 0.6, "low": 0.3, "high": 0.8, "k": 6, "n": 8},
    )
    summary = summarise_verdict(verdict)
    assert (summary.p_success, summary.varied_share) == (0.6, 0.75)
    assert summarise_verdict(replace(verdict, p_success=None)).varied_share is None
