"""The registry of measurements: nothing is measured that it does not define."""

import re
from pathlib import Path
from typing import Any

import pytest
from metric_lists import with_tables

from evaluator.compare import compare_csv, compare_run
from evaluator.compare.measure import measured
from evaluator.measurements import BIAS, REGISTRY, quantity_of
from evaluator.report.sections import NAMES, SECTIONS, numbers_of
from evaluator.result import Interval, Measurement
from evaluator.thresholds import SHORT

DOCS = Path(__file__).parents[2] / "docs"


def check(measurements: tuple[Measurement, ...]) -> None:
    assert measurements
    for measurement in measurements:
        quantity = quantity_of(measurement.id)
        assert quantity is not None, f"{measurement.id} is not in evaluator/measurements.py"
        assert quantity.unit == measurement.unit, measurement.id
        interval = measurement.interval
        ends = () if interval is None else (interval.low, interval.high)
        for value in (measurement.value, *ends):
            assert value is None or quantity.low <= value <= quantity.high, (measurement.id, value)


def test_every_measurement_of_a_run_is_registered_and_within_its_range(six_trials: Any) -> None:
    check(compare_run(six_trials.run).measurements)


def test_a_number_that_cannot_be_is_not_printed() -> None:
    """As a share of 188.9 percentage points, which stood in a report once."""
    defined = BIAS.of(what="over 3 groups", resampled="")
    wide = Interval(low=-300.0, high=120.0, level=0.95, method="x")
    found = measured(defined, lambda: (188.9, wide))
    assert found.value is None
    assert "188.9" in str(found.reason_if_undefined)
    kept = measured(defined, lambda: (8.0, wide), n=40)
    assert kept.interval is not None
    assert (kept.value, kept.interval.low, kept.interval.high) == (8.0, -100.0, 100.0)


def test_the_page_of_metrics_is_written_from_the_registry() -> None:
    page = (DOCS / "metrics.md").read_text()
    hint = "run: python tests/metric_lists.py"
    assert page == with_tables(page), hint
    missing = [q.id for q in REGISTRY if f"`{plain(q.id)}`" not in page]
    assert all(name.startswith("image.") for name in missing), hint  # as those of views


def plain(name: str) -> str:
    return re.sub(r"\{(\w+)\}", lambda part: part[1].upper(), name)


@pytest.mark.parametrize("name", ["paper_table_rates.csv", "paper_table_published.csv"])
def test_a_table_has_only_registered_measurements(name: str) -> None:
    check(compare_csv(DOCS / "examples" / name).measurements)


def test_what_the_report_shows_is_registered() -> None:
    named = [*SHORT.values(), *NAMES]
    unknown = [name for name in named if "*" not in name and quantity_of(name) is None]
    assert unknown == []


def test_every_named_number_stands_in_one_part() -> None:
    numbers = tuple(
        Measurement(id=name, value=0.0, unit=quantity.unit, definition="d")
        for name in NAMES
        if (quantity := quantity_of(name)) is not None
    )
    placed = [m.id for section in SECTIONS for _, m in numbers_of(section, numbers)]
    assert sorted(placed) == sorted(NAMES)


def test_a_quantity_finds_its_own_ids() -> None:
    for quantity in REGISTRY:
        words = dict.fromkeys(quantity.pattern.groupindex, "a b")
        filled = quantity.id.format(**dict.fromkeys(words, "a_b"))
        assert quantity.pattern.fullmatch(filled)
        found = quantity_of(filled)
        assert found is not None
        assert found.unit == quantity.unit
