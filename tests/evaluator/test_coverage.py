"""Intervals hold what they promise, and what does not is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from evaluator.compare.measure import measured, proportion
from evaluator.measurements import Defined
from evaluator.result import Interval
from evaluator.statistics import coverage
from evaluator.statistics.coverage import newcombe_coverage, rate_coverage
from evaluator.statistics.differences import newcombe_difference
from evaluator.statistics.intervals import RATE_INTERVALS, clopper_pearson, jeffreys, wilson
from evaluator.statistics.weighted import STATISTICS

REQUIRED = range(5, 101)
ANY = Defined(id="x", unit="1", definition="d")


def test_clopper_pearson_covers_95_percent_everywhere() -> None:
    for n in REQUIRED:
        assert rate_coverage("clopper-pearson", n).worst >= 0.95


def test_wilsons_mean_coverage_is_right_at_every_n() -> None:
    for n in REQUIRED:
        assert rate_coverage("wilson", n).mean >= 0.945


@pytest.mark.parametrize("method", RATE_INTERVALS)
@pytest.mark.parametrize("n", [1, 7, 23])
def test_coverage_of_a_rate_is_the_chance_of_the_counts_whose_interval_holds_it(
    method: str, n: int
) -> None:
    shares = []
    for rate in np.arange(0.05, 0.951, 0.01):
        made = [RATE_INTERVALS[method](k, n) for k in range(n + 1)]
        held = [k for k in range(n + 1) if made[k].low - 1e-12 <= rate <= made[k].high + 1e-12]
        shares.append(binom.pmf(held, n, rate).sum())
    found = rate_coverage(method, n)
    assert found.worst == pytest.approx(min(shares), abs=1e-9)
    assert found.mean == pytest.approx(np.mean(shares), abs=1e-9)


def an_interval(method: str, level: float = 0.95) -> Interval:
    return Interval(low=0.1, high=0.2, level=level, method=method)


def test_an_interval_that_covers_too_little_is_refused_and_another_is_named() -> None:
    kept, why = coverage.vouch(jeffreys(3, 10), 10)
    assert kept is None
    assert "jeffreys at 10 trials covers as little as 86.9 % where 95 % are claimed" in why
    assert "use wilson or clopper-pearson" in why


@pytest.mark.parametrize("key", coverage.HOLDS_FROM)
def test_below_its_number_an_interval_is_refused_with_what_would_be_enough(key: str) -> None:
    enough, unit = coverage.HOLDS_FROM[key]
    interval = an_interval(key.partition(":")[0])
    assert coverage.vouch(interval, enough, key=key)[0] == interval
    kept, why = coverage.vouch(interval, enough - 1, key=key)
    assert kept is None
    assert f"at {enough - 1} {unit} covers less than 90 % where 95 % are claimed; use " in why
    assert coverage.vouch(interval, enough - 1, key=key, instead="this")[1].endswith("use this")


def test_every_number_belongs_to_a_statistic_that_exists() -> None:
    names = {key.partition(":")[2] for key in coverage.HOLDS_FROM} - {"", "length"}
    assert names <= STATISTICS.keys()


def test_an_interval_that_holds_carries_its_worst_case() -> None:
    kept, why = coverage.vouch(wilson(3, 10), 10)
    assert why == ""
    assert kept is not None
    assert kept.worst_coverage == pytest.approx(0.9139, abs=1e-3)


def test_what_nobody_looked_at_passes_unmarked() -> None:
    assert coverage.vouch(an_interval("wilson", 0.9), 10) == (an_interval("wilson", 0.9), "")
    assert coverage.vouch(an_interval("block bootstrap"), 3)[0] == an_interval("block bootstrap")


def test_a_measurement_without_its_interval_says_why() -> None:
    rate = proportion(ANY, 1, 10, counted="trial", reason_if_undefined="r", method="jeffreys")
    assert rate.interval is None
    assert "jeffreys at" in str(rate.reason_without_interval)
    value = measured(ANY, lambda: (0.5, jeffreys(1, 10)), n=10)
    assert value.value == 0.5
    assert value.interval is None
    assert "use wilson" in str(value.reason_without_interval)


@pytest.mark.parametrize("sizes", [(6, 6), (3, 6), (7, 4)])
def test_coverage_of_two_groups_is_counted_out_with_the_interval_itself(
    sizes: tuple[int, int],
) -> None:
    n_first, n_second = sizes
    found = newcombe_coverage(n_first, n_second)
    shares = []
    for p_first in coverage.PAIR_RATES:
        for p_second in coverage.PAIR_RATES:
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
    kept, _ = coverage.vouch(made, (10, 10))
    assert kept is not None
    refused, why = coverage.vouch(made, (10, 16))
    assert refused is None
    assert "newcombe-10 at 10 and 16 trials covers as little as 88.3 %" in why
    assert "use clopper-pearson-difference" in why
    both = coverage.vouch(an_interval("clopper-pearson-difference"), (10, 16))[0]
    assert both is not None


def test_a_thousand_trials_are_counted_as_two_hundred() -> None:
    kept, _ = coverage.vouch(clopper_pearson(400, 1000), 1000)
    assert kept is not None
    assert kept.worst_coverage == round(rate_coverage("clopper-pearson", 200).worst, 4)
