"""``results.json``: written, read back, and refused when it does not fit."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.errors import InvalidRecordError, PathNotFoundError
from evaluator.compare import compare_run
from evaluator.errors import EvaluatorError
from evaluator.result import Interval, Measurement, Results, Table, load_results, write_results

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
