"""The model of the gap: a twin that follows, one that turns it round, one blind in some groups."""

import numpy as np
import pytest
from scipy import integrate, stats

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.gap_model import CENTRES, GapModel, GroupCounts, _likelihood, drawn

N = 30


def model(pairs: list[tuple[int, int]], **more: object) -> GapModel:
    return GapModel(
        groups=tuple(GroupCounts(recorded=(k, N), sim=(j, N), **more) for k, j in pairs)  # type: ignore[arg-type]
    )


FOLLOWS = [(k, min(N, k + 1)) for k in range(1, 30, 3)]


def test_a_twin_that_follows_has_a_high_r_and_one_that_turns_it_round_a_low_one() -> None:
    follows, turned = model(FOLLOWS), model([(k, N - j) for k, j in FOLLOWS])
    assert follows.r.low > 0.3
    assert turned.r.high < -0.3
    assert turned.r.low == pytest.approx(-follows.r.high, abs=0.05), "either sign alike"
    assert follows.bias.low < 1 / N < follows.bias.high
    again = model(FOLLOWS)
    assert (again.r, again.bias) == (follows.r, follows.bias), "equal counts give equal numbers"


def test_a_group_in_which_the_twin_is_blind_is_found() -> None:
    blind = model([*FOLLOWS, (2, N), (4, N)])
    chance = blind.blind_groups
    assert chance[-2:].min() > 0.5
    assert chance[:-2].max() < 0.5
    share, interval = blind.blind_share
    assert interval.low <= share <= interval.high
    assert share > model(FOLLOWS).blind_share[0]


def test_groups_that_share_a_task_count_as_fewer() -> None:
    alone = model(FOLLOWS)
    shared = GapModel(
        groups=tuple(
            GroupCounts(recorded=(k, N), sim=(j, N), shares=(f"task {place // 5}",))
            for place, (k, j) in enumerate(FOLLOWS)
        )
    )
    assert shared.design_effect > 2
    assert shared.r.high - shared.r.low > alone.r.high - alone.r.low
    assert shared.blind_groups == pytest.approx(alone.blind_groups), (
        "of these groups, not of others"
    )


def test_paired_trials_that_agree_by_their_start_say_less_than_others() -> None:
    """Few trials, sim and recorded alike in each: their starts may explain that."""
    tables = [(k, 0, 0, 8 - k) for k in (1, 4, 7, 4, 2, 6, 3, 5)]
    paired = GapModel(
        groups=tuple(GroupCounts(recorded=(0, 0), sim=(0, 0), pairs=t) for t in tables)
    )
    other = GapModel(groups=tuple(GroupCounts(recorded=(t[0], 8), sim=(t[0], 8)) for t in tables))
    assert paired.r.low < other.r.low - 0.5


def test_the_chance_of_a_count_is_its_mean_over_a_cell() -> None:
    found = _likelihood(GroupCounts(recorded=(3, 9), sim=(0, 0)), 0.0)[:, 0]
    ends = (CENTRES[8] + CENTRES[9]) / 2, (CENTRES[9] + CENTRES[10]) / 2
    low, high = (1 / (1 + np.exp(-end)) for end in ends)
    exact = integrate.quad(lambda p: stats.binom.pmf(3, 9, p), low, high)[0] / (high - low)
    assert found[9] * stats.binom.pmf(3, 9, 0.3) / exact == pytest.approx(
        stats.binom.pmf(3, 9, 0.3) * 10, rel=1e-3
    )


def test_r_and_bias_of_a_population_are_those_of_its_own_draws() -> None:
    """By drawing cells from what was laid out: coarser, and by other code."""
    there = drawn()
    rates = 1 / (1 + np.exp(-CENTRES))
    rng = np.random.default_rng(3)
    checked = 0
    for place, node in enumerate(there.may_be_blind[:60]):
        blind = rng.random(20_000) < there.share[node]
        cells = np.zeros(20_000, dtype=int)
        for rows, whose in ((~blind, there.seeing[node]), (blind, there.blind[place])):
            chances = whose.astype(np.float64)
            cells[rows] = rng.choice(len(chances), p=chances / chances.sum(), size=rows.sum())
        x, y = rates[cells // len(rates)], rates[cells % len(rates)]
        assert (y - x).mean() == pytest.approx(there.bias[node], abs=0.05)
        if min(x.std(), y.std()) > 0.15:
            assert np.corrcoef(x, y)[0, 1] == pytest.approx(there.r[node], abs=0.08)
            checked += 1
    assert checked > 15


def test_too_few_groups_and_a_side_without_trials_are_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="2 groups; it needs at least 3"):
        model(FOLLOWS[:2])
    with pytest.raises(UndefinedStatisticError, match="no trial on one side"):
        GapModel(groups=tuple(GroupCounts(recorded=(1, 2), sim=(0, 0)) for _ in range(3)))
