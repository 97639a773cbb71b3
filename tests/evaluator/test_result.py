"""``results.json``: written, read back, refused, and of nothing but registered measurements."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from metric_lists import with_tables

from bridge.errors import InvalidRecordError, PathNotFoundError
from evaluator.compare import compare_csv, compare_run
from evaluator.compare.measure import measured
from evaluator.errors import EvaluatorError
from evaluator.measurements import BIAS, REGISTRY, quantity_of
from evaluator.report.sections import NAMES, SECTIONS, numbers_of
from evaluator.result import Interval, Measurement, Results, Table, load_results, write_results
from evaluator.thresholds import SHORT

RATE = Measurement(
    id="rate.recorded.cube",
    value=0.8,
    unit="1",
    definition="successes / trials",
    interval=Interval(low=0.49, high=0.94, level=0.95, method="wilson"),
    k=8,
    n=10,
    counted="trial",
    episodes=("a", "b"),
)


def test_results_survive_writing_and_reading(six_trials: Any, tmp_path: Path) -> None:
    results = compare_run(six_trials.run).results()
    path = write_results(results, tmp_path / "results" / "results.json")
    assert load_results(path) == results
    assert load_results(tmp_path) == results
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_nan_never_becomes_a_measurement(value: float) -> None:
    with pytest.raises(ValueError, match="undefined and why"):
        Measurement(id="x", value=value, unit="1", definition="d")


def test_undefined_needs_its_reason_and_defined_has_none() -> None:
    with pytest.raises(ValueError, match="a value or a reason"):
        Measurement(id="x", value=None, unit="1", definition="d")
    with pytest.raises(ValueError, match="not both"):
        Measurement(id="x", value=1.0, unit="1", definition="d", reason_if_undefined="r")


def test_an_unknown_measurement_lists_those_there_are() -> None:
    results = Results(run="r", source="run", stand_in=None, measurements=(RATE,))
    with pytest.raises(EvaluatorError, match=r"no measurement 'x'.*rate.recorded.cube"):
        results.get("x")


def test_missing_results_say_how_to_make_them(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match="robot-gst evaluate"):
        load_results(tmp_path)


def spoiled(name: str) -> dict[str, object]:
    record = Results(run="r", source="run", stand_in=None, measurements=(RATE,)).to_record()
    measurement = record["measurements"][0]
    match name:
        case "newer":
            record["schema_version"] = 3
        case "no reason":
            measurement["value"] = None
        case "unknown field":
            measurement["p"] = 0.05
        case "unnamed method":
            del measurement["interval"]["method"]
        case "no such list":
            measurement["episodes"] = 7
    return record


@pytest.mark.parametrize(
    "name", ["newer", "no reason", "unknown field", "unnamed method", "no such list"]
)
def test_results_that_do_not_fit_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps(spoiled(name)))
    with pytest.raises(InvalidRecordError, match="results is invalid"):
        load_results(path)


def test_a_folder_that_cannot_be_written_is_one_clear_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    results = Results(run="r", source="run", stand_in=None, measurements=(RATE,))
    with pytest.raises(EvaluatorError, match="Choose another folder"):
        write_results(results, tmp_path / "file" / "results.json")


def test_a_list_of_episodes_is_written_once(tmp_path: Path) -> None:
    again = replace(RATE, id="rate.sim.cube")
    results = Results(run="r", source="run", stand_in=None, measurements=(RATE, again))
    record = results.to_record()
    assert record["episode_lists"] == [["a", "b"]]
    assert [item["episodes"] for item in record["measurements"]] == [0, 0]
    path = write_results(results, tmp_path / "results.json")
    assert json.loads(path.read_text()) == record
    assert load_results(path) == results


def test_results_of_version_one_are_still_read(tmp_path: Path) -> None:
    results = Results(run="r", source="run", stand_in=None, measurements=(RATE,))
    record = results.to_record() | {"schema_version": 1}
    del record["episode_lists"]
    record["measurements"][0]["episodes"] = ["a", "b"]
    path = tmp_path / "results.json"
    path.write_text(json.dumps(record))
    assert load_results(path) == results


@pytest.mark.parametrize("cell", [float("nan"), np.int64(3), Path("x")])
def test_a_table_holds_only_what_json_can_say(cell: Any) -> None:
    rows = (("a", 1.0),) * 30 + (("b", cell),)
    table = Table(id="t", title="t", columns=("a", "b"), rows=())
    results = Results(run="r", source="run", stand_in=None, measurements=(), tables=(table,))
    object.__setattr__(table, "rows", rows)  # past the checks of tests, which see cells by chance
    with pytest.raises(InvalidRecordError, match="table t"):
        results.to_record()


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
