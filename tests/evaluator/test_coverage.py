"""Intervals hold what they promise, the shipped map says so, and what does not is refused."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from evaluator.compare.measure import measured, proportion
from evaluator.measurements import Defined
from evaluator.result import Interval
from evaluator.statistics import coverage as stored
from evaluator.statistics.bootstrap import METHODS
from evaluator.statistics.coverage import choose_method, holds_from, newcombe_coverage
from evaluator.statistics.differences import (
    guaranteed_difference,
    newcombe_difference,
    tango_difference,
)
from evaluator.statistics.intervals import clopper_pearson, jeffreys, wilson
from evaluator.statistics.sequential import betting_interval
from evaluator.statistics.weighted import STATISTICS

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import coverage_drawn as simulate
import coverage_exact as exact
from coverage_drawn import (
    POPULATIONS,
    Population,
    of_agreement,
    of_remeasurements,
    truth,
)

REQUIRED = range(5, 101)

ANY = Defined(id="x", unit="1", definition="d")


def test_clopper_pearson_covers_95_percent_everywhere() -> None:
    for n in REQUIRED:
        found = exact.of_rate(clopper_pearson, n)
        assert found.worst >= 0.95, found


def test_wilsons_mean_coverage_is_right_at_every_n_and_its_minimum_is_stored() -> None:
    for n in REQUIRED:
        found = exact.of_rate(wilson, n)
        assert found.mean >= 0.945, found
        known = stored.coverage_of("wilson", n)
        assert known is not None
        assert known.worst == pytest.approx(found.worst, abs=1e-6)


@pytest.mark.parametrize("n", [5, 23, 60])
def test_the_shipped_map_is_what_counting_out_gives(n: int) -> None:
    for name, method in (("jeffreys", jeffreys), ("betting", betting_interval)):
        known = stored.coverage_of(name, n)
        assert known is not None
        assert known.worst == pytest.approx(exact.of_rate(method, n).worst, abs=1e-6)


@pytest.mark.parametrize("n", [3, 8])
def test_the_shipped_map_of_differences_is_what_counting_out_gives(n: int) -> None:
    for name, found in (
        ("newcombe-10", exact.of_difference(newcombe_difference, n)),
        ("clopper-pearson-difference", exact.of_difference(guaranteed_difference, n)),
        ("tango", exact.of_paired_difference(tango_difference, n)),
    ):
        known = stored.coverage_of(name, n)
        assert known is not None
        assert known.worst == pytest.approx(found.worst, abs=1e-6)


def test_what_is_guaranteed_is_kept() -> None:
    for name in ("clopper-pearson", "clopper-pearson-difference", "betting"):
        assert min(point.worst for point in stored.load_map()[name].points) >= 0.95


def test_coverage_counts_a_coin_by_hand() -> None:
    def half(k: int, n: int) -> Interval:
        """Hold everything up to 1/2, unless every toss succeeded."""
        high = 0.5 if k < n else 0.0
        return Interval(low=0.0, high=high, level=0.95, method="test")

    found = exact.of_rate(half, 2)
    # At p = 0.5 the two tosses succeed together in 1/4 of the cases; above 1/2 nothing is held.
    assert found.worst == 0
    assert found.mean == pytest.approx(
        float(np.mean([1 - p * p if p <= 0.5 else 0 for p in exact.RATES]))
    )


@pytest.mark.slow
def test_simulated_coverage_of_fisher_is_the_stored_one() -> None:
    from evaluator.statistics import agreement

    def make(groups: simulate.Groups, _: int, __: np.random.Generator) -> Interval:
        return agreement.fisher_interval(agreement.pearson(*groups), len(groups[0]))

    rng = np.random.default_rng(1)
    found = simulate.of_groups(make, "pearson", 10, POPULATIONS[:2], draws=100, rng=rng)
    known = stored.coverage_of("fisher-z", 10)
    assert known is not None
    assert abs(found.mean - known.mean) < 0.06  # 200 draws: 0.016, and fewer truths


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_simulated_coverage_of_every_statistic_is_the_stored_one() -> None:
    """A few draws at one size; the shipped map has many at eight."""
    rng = np.random.default_rng(2)
    found = of_agreement(8, POPULATIONS[2:4], draws=60, rng=rng)
    found |= of_remeasurements(6, POPULATIONS[2:4], draws=60, rng=rng)
    assert len(found) == len(METHODS) * len(STATISTICS) + len(STATISTICS)
    for name, coverage in found.items():
        known = stored.coverage_of(name, coverage.n)
        assert known is not None, name
        # 120 draws of two truths against hundreds of six: noise of 3 % and other truths.
        assert abs(coverage.mean - known.mean) < 0.12, name


def test_truths_of_what_is_known_by_hand() -> None:
    independent = Population(correlation=0.0, trials=1000)
    for statistic in ("pearson", "spearman", "kendall", "slope"):
        assert truth(statistic, independent, 5) == pytest.approx(0, abs=0.02)
    assert truth("order", independent, 5) == pytest.approx(0.5, abs=0.02)
    # Two independent uniform numbers are a third apart on average; here 0.9 of it.
    assert truth("mae", independent, 5) == pytest.approx(0.3, abs=0.01)
    assert truth("bias", independent, 5) == 0
    few, many = (truth("mmrv-recorded", independent, n) for n in (4, 20))
    assert few < many  # it grows with the number of groups


def test_correlated_groups_are_drawn_as_they_are_described() -> None:
    population = Population(correlation=0.9, trials=1000, cluster_share=0.5, groups_per_cluster=2)
    x, y = population.draw(20_000, np.random.default_rng(2))
    assert np.corrcoef(x, y)[0, 1] == pytest.approx(0.89, abs=0.01)  # uniform marginals
    first, second = x.reshape(-1, 2).T
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(0.48, abs=0.02)


def an_interval(method: str, level: float = 0.95) -> Interval:
    return Interval(low=0.1, high=0.2, level=level, method=method)


def test_an_interval_that_covers_too_little_is_refused_and_another_is_named() -> None:
    worst = {
        name: min(found.points, key=lambda point: point.worst)
        for name, found in stored.load_map().items()
    }
    refused = [n for n, point in worst.items() if point.worst < stored.FLOOR]
    refused = [name for name in refused if name not in stored.JUDGED_BY_MEAN]
    assert refused, "no method is ever refused: the map cannot be right"
    for name in refused:
        method = name.split(":")[0]
        kept, why = stored.vouch(an_interval(method), worst[name].n, key=name)
        assert kept is None
        assert "where 95 % are claimed" in why
        assert f"use {stored.INSTEAD[method]}" in why


def test_an_interval_that_holds_carries_its_worst_case() -> None:
    kept, why = stored.vouch(wilson(3, 10), 10)
    assert why == ""
    assert kept is not None
    assert kept.worst_coverage is not None
    assert 0.8 < kept.worst_coverage < 0.95
    unpaired = an_interval("clopper-pearson-difference, unpaired")
    kept, _ = stored.vouch(unpaired, 7)
    assert kept is not None
    assert kept.worst_coverage is not None


def test_what_nobody_looked_at_passes_unmarked_and_too_few_are_refused() -> None:
    assert stored.vouch(an_interval("wilson", 0.9), 10) == (an_interval("wilson", 0.9), "")
    assert stored.vouch(an_interval("block bootstrap"), 3)[0] == an_interval("block bootstrap")
    kept, why = stored.vouch(an_interval("ppi++"), 12)
    assert kept is None
    assert "coverage of ppi++ at 12 robot trials is not known" in why


def test_between_stored_sizes_the_worse_neighbour_counts_and_above_them_the_last() -> None:
    points = stored.load_map()["newcombe-10"].points
    sizes = [point.n for point in points]
    between = stored.coverage_of("newcombe-10", 60)
    assert between is not None
    neighbours = [point.worst for point in points if point.n in (50, 75)]
    assert between.worst == min(neighbours)
    assert stored.coverage_of("newcombe-10", 10**6) == points[sizes.index(max(sizes))]


def test_a_measurement_without_its_interval_says_why() -> None:
    jeffreys_refused = [p.n for p in stored.load_map()["jeffreys"].points if p.worst < 0.9]
    n = jeffreys_refused[0]
    rate = proportion(ANY, 1, n, counted="trial", reason_if_undefined="r", method="jeffreys")
    assert rate.interval is None
    assert "jeffreys at" in str(rate.reason_without_interval)
    value = measured(ANY, lambda: (0.5, jeffreys(1, n)), n=n)
    assert value.value == 0.5
    assert value.interval is None
    assert "use wilson" in str(value.reason_without_interval)


def test_every_statistic_of_agreement_is_in_the_map_by_every_method() -> None:
    held = stored.load_map()
    for statistic in STATISTICS:
        for kind in ("points", "clusters"):
            assert {f"{method}-{kind}:{statistic}" for method in METHODS} <= held.keys()
        assert f"remeasurement:{statistic}".removesuffix(":pearson") in held


@pytest.mark.parametrize("kind", ["points", "clusters"])
@pytest.mark.parametrize("statistic", STATISTICS)
def test_no_other_method_would_have_covered_more(statistic: str, kind: str) -> None:
    for n in (4, 8, 17, 60):
        choice = choose_method(statistic, kind, n)
        known = stored.coverage_of(choice.key, n)
        assert known is not None
        for method in METHODS:
            other = stored.coverage_of(f"{method}-{kind}:{statistic}", n)
            assert other is not None
            assert min(other.worst, 0.95) <= min(known.worst, 0.95) + 1e-12


def test_a_refusal_names_how_many_groups_would_be_enough() -> None:
    refused = [
        (statistic, n)
        for statistic in STATISTICS
        for n in (4, 5, 6)
        if (known := stored.coverage_of(choose_method(statistic, "clusters", n).key, n))
        and known.worst < stored.FLOOR
    ]
    assert refused, "four policies cannot be enough for every statistic"
    for statistic, n in refused:
        choice = choose_method(statistic, "clusters", n)
        method = choice.key.partition(":")[0]
        kept, why = stored.vouch(an_interval(method), n, key=choice.key, instead=choice.instead)
        assert kept is None
        assert f"use {choice.instead}" in why
        if "policies" in choice.instead:
            enough, name = choice.instead.split(", or ")[1].split(" policies, from where ")
            key = f"{name.removesuffix(' holds')}:{statistic}"
            assert int(enough) > n
            assert holds_from(key) == int(enough)


def test_a_statistic_that_is_not_in_the_map_is_refused() -> None:
    kept, why = stored.vouch(an_interval("jackknife-points"), 10, key="jackknife-points:regret")
    assert kept is None
    assert "coverage of jackknife-points for this statistic is not known" in why
    assert holds_from("jackknife-points:regret") is None


@pytest.mark.parametrize("sizes", [(6, 6), (3, 6), (7, 4)])
def test_coverage_of_unequal_groups_is_counted_out_with_the_interval_itself(
    sizes: tuple[int, int],
) -> None:
    n_first, n_second = sizes
    found = newcombe_coverage(n_first, n_second)
    if n_first == n_second:
        of_map = stored.coverage_of("newcombe-10", n_first)
        assert of_map is not None
        assert (found.worst, found.mean) == pytest.approx((of_map.worst, of_map.mean), abs=1e-6)
        return
    shares = []
    for p_first in stored.PAIR_RATES:
        for p_second in stored.PAIR_RATES:
            held = 0.0
            for first in range(n_first + 1):
                for second in range(n_second + 1):
                    interval = newcombe_difference(first, n_first, second, n_second)
                    if interval.low - 1e-12 <= p_second - p_first <= interval.high + 1e-12:
                        chance = binom.pmf(first, n_first, p_first)
                        held += chance * binom.pmf(second, n_second, p_second)
            shares.append(held)
    assert found.worst == pytest.approx(min(shares), abs=1e-9)
    assert found.mean == pytest.approx(np.mean(shares), abs=1e-9)


def test_groups_of_different_size_are_not_judged_by_the_smaller_one() -> None:
    # Ten and ten trials cover enough, ten and sixteen do not.
    made = replace(newcombe_difference(4, 10, 9, 16), method="newcombe-10, unpaired")
    kept, _ = stored.vouch(made, (10, 10))
    assert kept is not None
    refused, why = stored.vouch(made, (10, 16))
    assert refused is None
    assert "newcombe-10 at 10 and 16 trials per group covers as little as 88.3 %" in why
    assert "use clopper-pearson-difference" in why
    both = stored.vouch(an_interval("clopper-pearson-difference"), (10, 16))[0]
    assert both is not None
