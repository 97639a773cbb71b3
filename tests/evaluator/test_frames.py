"""An evaluation as DataFrames: the same numbers as on disk, with types."""

from pathlib import Path

import pandas as pd
import pytest
from own_process import printed

import evaluator
from bridge.episode.run_folder import RunFolder
from bridge.errors import PathNotFoundError
from evaluator.compare import compare_run
from evaluator.report.write import write_report
from evaluator.result import load_results


@pytest.fixture(scope="module")
def results(six_trials_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluated") / "monday" / "results"
    write_report(compare_run(RunFolder(six_trials_once)), folder)
    return folder


def test_groups_are_the_rates_of_each_side_with_their_counts(results: Path) -> None:
    groups = evaluator.read_groups(results.parent)
    assert set(groups["side"]) == {"recorded", "sim_planned", "sim_executed", "verdict"}
    recorded = groups[groups["side"] == "recorded"]
    assert (recorded["rate"] == recorded["k"] / recorded["n"]).all()
    assert (recorded["low"] < recorded["rate"]).all()
    found = load_results(results / "results.json")
    for row in recorded.to_dict("records"):
        measured = found.get(f"rate.recorded.{row['task']}.{row['condition']}.{row['policy']}")
        assert (measured.value, measured.counted) == (row["rate"], row["unit"])


def test_measurements_keep_every_number_and_say_which_way_is_better(results: Path) -> None:
    frame = evaluator.read_measurements(results.parent)
    found = load_results(results / "results.json").measurements
    assert frame["id"].tolist() == [measurement.id for measurement in found]
    values = [None if pd.isna(value) else value for value in frame["value"]]
    assert values == [measurement.value for measurement in found]
    by_id = frame.set_index("id")
    assert by_id.loc["agreement.mae_pp", "better"] == "lower"
    assert by_id.loc["agreement.sim_planned.rate", "better"] == "higher"


def test_trials_are_those_of_the_csv_and_an_unknown_answer_stays_unknown(results: Path) -> None:
    trials = evaluator.read_trials(results.parent)
    assert len(trials) == 6
    assert trials["recorded"].dtype == "boolean"
    assert trials["p_success"].isna().all()
    groups = evaluator.read_groups(results.parent)
    rates = trials.groupby(["task", "condition", "policy"])["recorded"].mean()
    for key, rate in rates.items():
        same = (groups[["task", "condition", "policy"]] == list(key)).all(axis=1)
        assert groups[same & (groups["side"] == "recorded")]["rate"].item() == rate


def test_a_run_that_was_not_evaluated_says_how(tmp_path: Path) -> None:
    for read in (evaluator.read_trials, evaluator.read_groups, evaluator.read_measurements):
        with pytest.raises(PathNotFoundError, match="robot-gst evaluate"):
            read(tmp_path)


def test_importing_evaluator_loads_no_pandas() -> None:
    code = "import sys, evaluator; print('pandas' in sys.modules, 'numpy' in sys.modules)"
    assert printed(code) == "False False"
