"""Agreement of varied replays: their rates, the interval of r, and what is not decided by them."""

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit

from bridge.task.verdict import Factor, Verdict
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.model import headline_interval
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import rate_groups, side_rates
from evaluator.compare.varied_agreement import (
    REPLICATES,
    VariedIntervals,
    drawn_answers,
    varied_agreement,
)
from evaluator.result import Interval, Measurement
from evaluator.run_reader.episodes import summarise_verdict

TASKS = ("stack", "slippery", "heavy", "beside", "into", "on", "push", "sort")
POLICIES = ("careful",)
"""One, so that no groups share a task: that model is quick to fit."""
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
    assert varied.interval is not None
    assert varied.interval.low < reference
    assert f"{REPLICATES}-varied-replays" in varied.interval.method
    gap = 100 * float(np.mean([sim - recorded for recorded, sim in means]))
    assert results.get("agreement.varied.bias_pp").value == pytest.approx(gap)
    assert results.get("agreement.varied.mmrv_recorded_gap").value is not None


def test_a_twin_that_is_wrong_the_other_way_round_has_a_negative_r() -> None:
    rows = rows_of(spread_rates(), share=lambda rng, rate: 1.0 - rate)
    varied = found(rows)["agreement.varied.pearson_r"]
    assert varied.value is not None
    assert varied.value < -0.8
    assert varied.interval is not None
    assert varied.interval.high < 0.5


def test_shares_of_none_and_all_have_the_interval_of_nominal_replays() -> None:
    """A varied replay that says what the nominal one does is the nominal one."""
    rows = rows_of(spread_rates(), share=lambda rng, rate: float(rng.random() < rate))
    rows = [replace(row, sim_planned=row.sim_varied == 1.0) for row in rows]
    nominal = headline_interval("pearson", rate_groups(rows, side_rates(rows)))
    varied = found(rows)["agreement.varied.pearson_r"].interval
    assert nominal is not None
    assert varied is not None
    assert (varied.low, varied.high) == pytest.approx((nominal.low, nominal.high), abs=0.06)


def test_each_share_comes_out_over_the_replicates() -> None:
    shares = [0.0, 0.125, 0.25, 0.5, 0.75, 1.0]
    rows = [
        replace(rows_of({("a", "b"): 0.5}, share=eighths, trials=1)[0], sim_varied=share)
        for share in shares
        for _ in range(500)
    ]
    said = drawn_answers(rows, np.random.default_rng(1)).reshape(len(shares), 500, REPLICATES)
    np.testing.assert_allclose(said.mean(axis=(1, 2)), shares, atol=0.03)
    np.testing.assert_allclose(
        said.mean(axis=1), np.repeat(shares, REPLICATES).reshape(6, -1), atol=0.09
    )
    counts = said.sum(axis=2)
    assert np.all(np.abs(counts - REPLICATES * np.array(shares)[:, None]) < 1)


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


SIMULATIONS = int(os.environ.get("GST_COVERED", "12"))
"""Each takes four fits; `make soak` does forty."""
MISSES = 1 + SIMULATIONS // 10
"""Of 95 %, more have a chance of 2 % at 12 and of 1.4 % at 40."""


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_the_interval_of_r_covers_the_correlation_of_groups_like_these() -> None:
    """Simulated: log-odds of groups, correlated 0.7, ten trials each.

    Each trial has a chance of its own on either side, of which its outcome and its shares are
    draws, so that both sides err together as those of one start do.
    """
    rng = np.random.default_rng(7)
    covariance = np.array([[2.0, 1.4], [1.4, 2.0]])
    many = rng.multivariate_normal([0, 0], covariance, 200_000)
    truth = float(np.corrcoef(expit(many).T)[0, 1])
    held, widths = 0, []
    for turn in range(SIMULATIONS):
        interval = _simulated(np.random.default_rng([7, turn]), covariance)
        held += interval.low <= truth <= interval.high
        widths.append(interval.high - interval.low)
    assert held >= SIMULATIONS - MISSES
    assert np.mean(widths) < 1.3, "wide enough to say nothing is no interval"


def _simulated(rng: np.random.Generator, covariance: np.ndarray) -> Interval:
    groups, members = [], []
    for task in range(12):
        recorded, sim = rng.multivariate_normal([0, 0], covariance)
        mine = [
            replace(
                rows_of({(f"t{task}", "p"): 0.5}, share=eighths, trials=1)[0],
                recorded=bool(u < expit(recorded)),
                sim_varied=float(np.clip(0.7 * (u < expit(sim)) + 0.3 * expit(sim), 0, 1)),
            )
            for u in rng.random(10)
        ]
        members.append(mine)
        groups += rate_groups(mine, side_rates(mine))
    found = VariedIntervals(groups, members).model("pearson")
    assert found is not None
    return found
