"""Statistics over many weighted sets at once are the plain ones, set by set."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from evaluator.errors import UndefinedStatisticError
from evaluator.statistics import agreement
from evaluator.statistics.bootstrap import (
    SCALES,
    GroupSample,
    remeasure_counts,
    remeasure_paired,
)
from evaluator.statistics.weighted import STATISTICS, values_of

PLAIN: dict[str, Callable[[Any, Any], float]] = {
    "pearson": agreement.pearson,
    "spearman": agreement.spearman,
    "bias": lambda x, y: agreement.bias(recorded=x, sim=y),
    "mae": lambda x, y: agreement.mean_absolute_error(recorded=x, sim=y),
    "order": lambda x, y: agreement.order_accuracy(recorded=x, sim=y).value,
    "mmrv-recorded": lambda x, y: agreement.mmrv(recorded=x, sim=y),
}


def plain(statistic: str, recorded: list[float], sim: list[float]) -> float | None:
    try:
        return PLAIN[statistic](recorded, sim)
    except UndefinedStatisticError:
        return None


def test_every_statistic_has_a_plain_twin_and_a_scale() -> None:
    assert PLAIN.keys() == STATISTICS.keys() == SCALES.keys()


@pytest.mark.parametrize("statistic", PLAIN)
def test_counting_groups_several_times_is_repeating_them(statistic: str) -> None:
    rng = np.random.default_rng(4)
    recorded, sim = rng.integers(0, 6, (2, 7)) / 5  # few values, so that there are ties
    counts = rng.multinomial(7, np.full(7, 1 / 7), size=40)
    values, defined = values_of(statistic, counts.astype(np.float64), recorded, sim)
    for count, value, known in zip(counts, values, defined, strict=True):
        wanted = plain(
            statistic, np.repeat(recorded, count).tolist(), np.repeat(sim, count).tolist()
        )
        assert known == (wanted is not None)
        if wanted is not None:
            assert value == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("statistic", PLAIN)
def test_sets_with_rates_of_their_own_are_the_plain_statistic_of_each(statistic: str) -> None:
    rng = np.random.default_rng(5)
    recorded, sim = rng.integers(0, 6, (2, 60, 5)) / 5
    values, defined = values_of(statistic, np.ones((60, 5)), recorded, sim)
    for x, y, value, known in zip(recorded, sim, values, defined, strict=True):
        wanted = plain(statistic, x.tolist(), y.tolist())
        assert known == (wanted is not None)
        if wanted is not None:
            assert value == pytest.approx(wanted, abs=1e-12)


def test_a_jackknife_of_a_mean_is_students_interval() -> None:
    from evaluator.statistics.bootstrap import student_interval

    recorded, sim = [0.1, 0.5, 0.6, 0.9, 0.3], [0.2, 0.4, 0.9, 0.8, 0.35]
    sample = GroupSample(recorded=recorded, sim=sim)
    mine = sample.interval("bias")
    theirs = student_interval([s - r for r, s in zip(recorded, sim, strict=True)])
    assert (mine.low, mine.high) == pytest.approx((theirs.low, theirs.high), abs=1e-12)
    assert mine.method == "jackknife-points"


def test_no_interval_is_given_at_the_end_of_a_range_or_without_variation() -> None:
    up = [0.1, 0.2, 0.3, 0.4, 0.5]
    sample = GroupSample(recorded=up, sim=up)
    for statistic, why in (
        ("spearman", "no width"),
        ("mae", "no width"),
        ("mmrv-recorded", "no width"),
    ):
        with pytest.raises(UndefinedStatisticError, match=why):
            sample.interval(statistic)
    counts = [(1, 9), (3, 9), (5, 9), (7, 9)]
    with pytest.raises(UndefinedStatisticError, match="1 exactly, the end of its range"):
        remeasure_counts(counts, counts, rng=np.random.default_rng(0)).band("spearman")


@pytest.mark.parametrize("statistic", ["pearson", "mae", "bias", "mmrv-recorded"])
def test_a_band_of_remeasurement_holds_what_was_found_and_shrinks_with_trials(
    statistic: str,
) -> None:
    few = [(5, 1, 1, 3), (8, 1, 0, 1), (2, 2, 1, 5), (4, 0, 3, 3)]
    many = [(a * 50, b * 50, c * 50, d * 50) for a, b, c, d in few]
    wide = remeasure_paired(few, rng=np.random.default_rng(3)).band(statistic)
    narrow = remeasure_paired(many, rng=np.random.default_rng(3)).band(statistic)
    assert narrow.high - narrow.low < wide.high - wide.low
    recorded = [(a + c) / 10 for a, _, c, _ in few]
    sim = [(a + b) / 10 for a, b, _, _ in few]
    value = plain(statistic, recorded, sim)
    assert value is not None
    assert wide.low <= value <= wide.high


def test_paired_trials_are_redrawn_together() -> None:
    """Sides that always agree stay equal in every redrawn table."""
    found = remeasure_paired([(7, 0, 0, 3)] * 4, rng=np.random.default_rng(0))
    difference = np.abs(found.recorded_again - found.sim_again).mean()
    apart = remeasure_counts([(7, 10)] * 4, [(7, 10)] * 4, rng=np.random.default_rng(0))
    assert difference < 0.5 * np.abs(apart.recorded_again - apart.sim_again).mean()
