"""The model of both sides against laws, a table of Simpson's, and a twin that is useless."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import expit

from evaluator.compare.spreadsheet import compare_csv
from evaluator.errors import UndefinedStatisticError
from evaluator.report.front import front
from evaluator.statistics.differences import mean_of_intervals, newcombe_difference
from evaluator.statistics.group_likelihood import GroupCounts, Likelihood, Nodes, Spread
from evaluator.statistics.hierarchical import (
    AgreementModel,
    estimate,
    from_normal,
    population,
    to_normal,
)

Counts = Sequence[tuple[str, int, int, int, int]]
NODES = 4096
"""A quarter of what the evaluator takes."""
EIGHT: Counts = [
    ("a", 3, 10, 6, 10),
    ("b", 9, 10, 9, 10),
    ("c", 0, 10, 1, 10),
    ("d", 6, 10, 6, 10),
    ("e", 6, 10, 8, 10),
    ("f", 9, 10, 10, 10),
    ("g", 1, 10, 2, 10),
    ("h", 5, 10, 8, 10),
]


def groups_of(counts: Counts) -> list[GroupCounts]:
    return [GroupCounts(recorded=(a, b), sim=(c, d), task=task) for task, a, b, c, d in counts]


def swapped(counts: Counts) -> list[GroupCounts]:
    return [GroupCounts(recorded=(c, d), sim=(a, b), task=task) for task, a, b, c, d in counts]


@pytest.fixture(scope="module", autouse=True)
def few_nodes() -> None:
    """Let the evaluator be as exact as it is for users."""


@pytest.fixture(scope="module")
def eight() -> AgreementModel:
    return AgreementModel(groups_of(EIGHT), num_nodes=NODES)


def test_a_group_has_the_probability_that_scipy_integrates() -> None:
    groups = groups_of([("a", 3, 10, 14, 20), ("b", 0, 5, 1, 7), ("c", 4, 5, 5, 5)])
    phi = np.array([[-0.3, 0.4, 1.1, 0.8, np.arcsin(0.6)]])
    like = Likelihood(groups)
    more = (like.step / 2) ** 2
    cov = np.array([[1.21 + more, 0.6 * 0.88], [0.6 * 0.88, 0.64 + more]])
    normal = stats.multivariate_normal([-0.3, 0.4], cov)

    steps = np.linspace(-7, 7, 561)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    density = normal.pdf(np.stack([x, y], axis=-1))

    def integral(group: GroupCounts) -> float:
        (k, n), (m, o) = group.totals
        chance = stats.binom.pmf(k, n, expit(x)) * stats.binom.pmf(m, o, expit(y))
        return float(integrate.simpson(integrate.simpson(chance * density, steps), steps))

    wanted = [integral(group) for group in groups]
    alone = [Likelihood([group] * 3).log(phi)[0] / 3 for group in groups]
    peaks = [
        stats.binom.pmf(k, n, k / n) * stats.binom.pmf(m, o, m / o)
        for (k, n), (m, o) in (group.totals for group in groups)
    ]
    # The evaluator leaves out what does not depend on rates: the largest value of each table.
    ratio = [np.exp(a) * b / c for a, b, c in zip(alone, peaks, wanted, strict=True)]
    assert ratio == pytest.approx([1.0, 1.0, 1.0], rel=2e-2)


def test_equal_counts_give_equal_numbers_and_another_seed_hardly_moves_them(
    eight: AgreementModel,
) -> None:
    again = AgreementModel(groups_of(EIGHT), num_nodes=NODES)
    assert again.pearson_others == eight.pearson_others
    other = AgreementModel(groups_of(EIGHT), num_nodes=NODES, seed=5)
    for first, second in (
        (eight.pearson_others, other.pearson_others),
        (eight.bias_others, other.bias_others),
    ):
        assert abs(first.mean - second.mean) < 0.05 * first.sd


def test_sides_change_places(eight: AgreementModel) -> None:
    other = AgreementModel(swapped(EIGHT), num_nodes=NODES)
    assert other.pearson_others.mean == pytest.approx(eight.pearson_others.mean, abs=0.02)
    assert other.bias_others.mean == pytest.approx(-eight.bias_others.mean, abs=0.005)


def test_more_trials_and_more_groups_say_more(eight: AgreementModel) -> None:
    more = [(task, 5 * a, 5 * b, 5 * c, 5 * d) for task, a, b, c, d in EIGHT]
    sharper = AgreementModel(groups_of(more), num_nodes=NODES).pearson_others
    rough = eight.pearson_others
    assert sharper.high - sharper.low < rough.high - rough.low
    twice = [*EIGHT, *((f"{task}2", a, b, c, d) for task, a, b, c, d in EIGHT)]
    wider = AgreementModel(groups_of(twice), num_nodes=NODES).pearson_others
    assert wider.high - wider.low < rough.high - rough.low


def test_small_groups_are_drawn_towards_the_others(eight: AgreementModel) -> None:
    never = eight.draws.recorded[:, 2].mean()
    assert 0.02 < never < 0.25  # 0 of 10 is no proof of never
    assert eight.draws.recorded[:, 1].mean() < 0.9


def test_pairs_that_agree_make_the_bias_sharper() -> None:
    tables = [(5, 1, 0, 4), (3, 1, 0, 6), (7, 1, 0, 2), (4, 2, 0, 4), (6, 1, 1, 2)]
    paired = [
        GroupCounts(recorded=(0, 0), sim=(0, 0), pairs=table, task=str(i))
        for i, table in enumerate(tables)
    ]
    apart = [
        GroupCounts(recorded=group.totals[0], sim=group.totals[1], task=group.task)
        for group in paired
    ]
    sharp, rough = (
        estimate(AgreementModel(g, num_nodes=NODES).draws.gap.mean(axis=1)) for g in (paired, apart)
    )
    assert sharp.sd < 0.8 * rough.sd
    assert sharp.mean == pytest.approx(rough.mean, abs=0.03)


def test_normal_numbers_stand_for_parameters_with_their_prior() -> None:
    z = np.tile(np.array([-6.0, -1.0, 0.3, 2.0, 6.0])[:, None], 8)
    phi = from_normal(z)
    share = stats.norm.cdf(z)
    assert stats.norm(scale=2.5).cdf(phi[:, :2]) == pytest.approx(share[:, :2])
    for at in (2, 5):
        sizes = phi[:, at : at + 2]
        assert (sizes >= 0).all()
        assert stats.halfnorm(scale=2.5).sf(sizes) == pytest.approx(1 - share[:, :2], rel=1e-6)
        angle = stats.norm.cdf((1.0 if at == 2 else 0.5 + np.sqrt(0.75)) * z[:, 0])
        assert phi[:, at + 2] / np.pi + 0.5 == pytest.approx(angle, abs=1e-12)
    assert to_normal(phi[1]) == pytest.approx(z[1])
    assert to_normal(phi[3]) == pytest.approx(z[3])
    drawn = from_normal(np.random.default_rng(3).standard_normal((20_000, 8)))
    for at in (4, 7):  # each correlation alone has a uniform arcsine
        assert stats.kstest(drawn[:, at] / np.pi + 0.5, "uniform").pvalue > 1e-3
    alike = stats.norm.ppf(drawn[:, [4, 7]] / np.pi + 0.5)
    assert np.corrcoef(alike.T)[0, 1] == pytest.approx(0.5, abs=0.03)


def test_rates_that_cannot_be_told_from_one_have_their_place_on_the_grid() -> None:
    at = stats.norm(4, 5)
    chance = integrate.quad(lambda x: expit(x) ** 5 * at.pdf(x), -40, 60, points=(0,))[0]
    rate = integrate.quad(lambda x: expit(x) ** 6 * at.pdf(x), -40, 60, points=(0,))[0] / chance
    like = Likelihood(groups_of([(name, 5, 5, 5, 5) for name in "abc"]))
    _, rates = like.log_and_rates(np.array([[4.0, 4.0, 5.0, 5.0, 0.0]]))
    assert rates[0, :, 0] == pytest.approx([rate] * 3, abs=1e-3)


def test_the_population_has_the_correlation_that_draws_have() -> None:
    spread = Spread(first=np.array([1.5]), second=np.array([2.0]), rho=np.array([0.7]))
    nodes = Nodes(mean=np.array([[0.5, -1.0]]), within=spread, between=None)
    r, bias = population(nodes)
    cov = [[2.25, 2.1], [2.1, 4.0]]
    rates = expit(np.random.default_rng(0).multivariate_normal([0.5, -1.0], cov, 400_000))
    assert r[0] == pytest.approx(np.corrcoef(rates.T)[0, 1], abs=0.005)
    assert bias[0] == pytest.approx(rates[:, 1].mean() - rates[:, 0].mean(), abs=0.003)


@pytest.mark.parametrize("counts", [EIGHT[:2], [*EIGHT[:3], ("x", 0, 0, 1, 2)]])
def test_too_little_is_refused(counts: Counts) -> None:
    with pytest.raises(UndefinedStatisticError):
        AgreementModel(groups_of(counts))


def test_the_interval_of_a_mean_gain_covers() -> None:
    """Three tasks of 10 trials per arm: 4,000 draws of different rates."""
    rng = np.random.default_rng(3)
    table = {(a, b): newcombe_difference(a, 10, b, 10) for a in range(11) for b in range(11)}
    held = 0
    for _ in range(4000):
        before, after = rng.uniform(0.1, 0.9, (2, 3))
        k, m = rng.binomial(10, before), rng.binomial(10, after)
        each = [table[a, b] for a, b in zip(k.tolist(), m.tolist(), strict=True)]
        found = mean_of_intervals(((m - k) / 10).tolist(), each)
        held += found.low <= (after - before).mean() <= found.high
    assert held / 4000 > 0.925
    alone = newcombe_difference(3, 10, 8, 10)
    same = mean_of_intervals([0.5], [alone])
    assert (same.low, same.high) == pytest.approx((alone.low, alone.high))


SIMPSON = "task,condition,side,unit,k,n\n" + "".join(
    f"{task},{condition},{side},trial,{k},20\n"
    for task, base in (("a", 2), ("b", 9), ("c", 15))
    for condition, recorded, sim in (("x", 0, 4), ("y", 2, 2), ("z", 4, 0))
    for side, k in (("real", base + recorded), ("sim", base + sim))
)


def test_a_table_of_simpsons_is_said(write_table: Callable[[str], Path]) -> None:
    results = compare_csv(write_table(SIMPSON)).results()
    r = results.get("agreement.pearson_r")
    assert r.value is not None
    assert r.value > 0.7
    notes = next(table.rows for table in results.tables if table.id == "notes")
    assert notes[0][0] == "agreement.pearson_r"
    assert "inside tasks r = -1.00" in str(notes[0][1])
    within = results.get("agreement.model.r_within")
    between = results.get("agreement.model.r_between")
    assert within.value is not None
    assert between.value is not None
    assert within.value < 0 < between.value
    assert front(results).summary.startswith(str(notes[0][1]))  # the report leads with it
    assert all("Simpson" not in text for _, text in front(results).notes)
