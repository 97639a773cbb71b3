"""The registry of measurements: nothing is measured that it does not define."""

from pathlib import Path
from typing import Any

import pytest

from evaluator.compare import compare_csv, compare_run
from evaluator.measurements import REGISTRY, quantity_of
from evaluator.report.sections import SECTIONS
from evaluator.report.wording import HEADLINES
from evaluator.result import Measurement
from evaluator.thresholds import SHORT

DOCS = Path(__file__).parents[2] / "docs"


def check(measurements: tuple[Measurement, ...]) -> None:
    assert measurements
    for measurement in measurements:
        quantity = quantity_of(measurement.id)
        assert quantity is not None, f"{measurement.id} is not in evaluator/measurements.py"
        assert quantity.unit == measurement.unit, measurement.id


def test_a_run_has_only_registered_measurements(six_trials: Any) -> None:
    check(compare_run(six_trials.run).measurements)


@pytest.mark.parametrize("name", ["paper_table_rates.csv", "paper_table_published.csv"])
def test_a_table_has_only_registered_measurements(name: str) -> None:
    check(compare_csv(DOCS / "examples" / name).measurements)


def test_what_the_report_shows_is_registered() -> None:
    named = [*SHORT.values(), *(name for name, _ in HEADLINES)]
    named += [pattern for section in SECTIONS for pattern, _ in section.numbers]
    unknown = [name for name in named if "*" not in name and quantity_of(name) is None]
    assert unknown == []


def test_a_quantity_finds_its_own_ids() -> None:
    for quantity in REGISTRY:
        words = dict.fromkeys(quantity.pattern.groupindex, "a b")
        filled = quantity.id.format(**dict.fromkeys(words, "a_b"))
        assert quantity.pattern.fullmatch(filled)
        found = quantity_of(filled)
        assert found is not None
        assert found.unit == quantity.unit
