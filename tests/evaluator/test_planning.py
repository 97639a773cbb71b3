"""Sizes of studies against counting by hand, SciPy and statsmodels."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics.differences import sign_test, tango_difference
from evaluator.statistics.intervals import wilson
from evaluator.statistics.planning import (
    holm,
    paired_chances,
    paired_width,
    pairs_for_power,
    pairs_for_width,
    power_above,
    rate_width,
    trials_above,
)
from evaluator.statistics.power import power_paired


@pytest.mark.parametrize("mid", [False, True])
@pytest.mark.parametrize("n", [1, 7, 23])
def test_the_power_is_the_probability_of_all_significant_counts(n: int, *, mid: bool) -> None:
    chances = (0.35, 0.15)
    total = 0.0
    for improved in range(n + 1):
        for worsened in range(n + 1 - improved):
            counts = (improved, worsened, n - improved - worsened)
            if improved + worsened and sign_test(improved, worsened)[mid] <= 0.05:
                total += stats.multinomial.pmf(counts, n, [*chances, 0.5])
    assert power_paired(*chances, n, mid=mid) == pytest.approx(total, abs=1e-10)


def test_the_pairs_are_the_fewest_with_the_power() -> None:
    needed = pairs_for_power(0.4, 0.1, power=0.8)
    assert power_paired(0.4, 0.1, needed, mid=True) >= 0.8
    assert power_paired(0.4, 0.1, needed - 1, mid=True) < 0.8
    assert needed < pairs_for_power(0.4, 0.1, power=0.9) < pairs_for_power(0.35, 0.15, power=0.9)
    with pytest.raises(UndefinedStatisticError, match="no number of pairs"):
        pairs_for_power(0.2, 0.2)
    with pytest.raises(UndefinedStatisticError, match="more than 4000 pairs"):
        pairs_for_power(0.201, 0.2)


def test_chances_of_pairs_have_the_rates_and_the_correlation() -> None:
    improved, worsened = paired_chances(0.5, 0.7, 0.3)
    both = 0.7 - improved
    assert improved - worsened == pytest.approx(0.2)
    assert (both - 0.35) / np.sqrt(0.25 * 0.21) == pytest.approx(0.3)
    assert paired_chances(0.5, 0.9, 1.0) == pytest.approx((0.4, 0.0))  # cut to what can be


@pytest.mark.parametrize("n", [10, 40])
def test_the_width_of_the_gain_is_its_expectation(n: int) -> None:
    chances = (0.3, 0.1)
    expected = 0.0
    for improved in range(n + 1):
        for worsened in range(n + 1 - improved):
            mass = stats.multinomial.pmf(
                (improved, worsened, n - improved - worsened), n, [*chances, 0.6]
            )
            if mass > 1e-4:
                found = tango_difference(improved, worsened, n)
                expected += mass * (found.high - found.low)
    assert paired_width(*chances, n) == pytest.approx(expected, rel=0.03)


def test_widths_shrink_to_what_is_wanted() -> None:
    needed = pairs_for_width(0.3, 0.1, 0.3)
    assert paired_width(0.3, 0.1, needed) <= 0.3 < paired_width(0.3, 0.1, needed - 2)
    mass = stats.binom.pmf(np.arange(13), 12, 0.6)
    ends = [wilson(k, 12) for k in range(13)]
    assert rate_width(0.6, 12) == pytest.approx(mass @ [e.high - e.low for e in ends])


def test_the_claim_of_agreement_needs_trials_whose_interval_lies_above() -> None:
    needed = trials_above(0.85, 0.7)
    assert power_above(0.85, 0.7, needed) >= 0.8 > power_above(0.85, 0.7, needed - 1)
    shown = [k for k in range(31) if wilson(k, 30).low > 0.6]
    assert power_above(0.8, 0.6, 30) == pytest.approx(stats.binom.pmf(shown, 30, 0.8).sum())
    with pytest.raises(UndefinedStatisticError, match="is not above"):
        trials_above(0.7, 0.7)


def test_holm_is_that_of_statsmodels() -> None:
    p = [0.04, 0.001, 0.2, 0.03, 0.9]
    assert holm(p) == pytest.approx(multipletests(p, method="holm")[1])
    assert holm([]) == []
