"""Parquet says what CSV and JSON say, with types; without a package the report is still written."""

import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from own_process import printed

from bridge.episode.run_folder import RunFolder
from bridge.exchange.trials_csv import TrialRecord, read_trials
from evaluator.compare import compare_run
from evaluator.report.parquet import OF_MEASUREMENTS, OF_TRIALS, write_measurements, write_trials
from evaluator.report.write import Written, summary_text, write_report
from evaluator.result import load_results


def plain(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows as Python values; null becomes None."""
    rows = frame.astype(object).where(frame.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


def trials_in(frame: pd.DataFrame) -> list[TrialRecord]:
    return [TrialRecord(**row) for row in plain(frame)]


@pytest.fixture(scope="module")
def written(six_trials_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Written:
    folder = tmp_path_factory.mktemp("written") / "results"
    return write_report(compare_run(RunFolder(six_trials_once)), folder)


def test_trials_read_back_are_the_trials_of_the_csv(written: Written) -> None:
    folder = written.report.parent
    assert folder / "trials.parquet" in written.files
    frame = pd.read_parquet(folder / "trials.parquet", dtype_backend="numpy_nullable")
    assert trials_in(frame) == read_trials(folder / "trials.csv")
    assert len(frame) == 6
    assert frame["recorded"].dtype == "boolean"


def test_an_unknown_answer_stays_unknown(tmp_path: Path) -> None:
    trials = [
        TrialRecord(trial_id="a", task="t", recorded=True, k=1, n=1, p_success=0.25),
        TrialRecord(trial_id="b", task="t,'\n", recorded=False),
        TrialRecord(trial_id="c", task="t", stand_in=True),
    ]
    frame = pd.read_parquet(
        write_trials(tmp_path / "t.parquet", trials), dtype_backend="numpy_nullable"
    )
    assert trials_in(frame) == trials
    assert frame["recorded"].isna().tolist() == [False, False, True]


def test_measurements_read_back_are_those_of_the_results_file(written: Written) -> None:
    folder = written.report.parent
    rows = plain(pd.read_parquet(folder / "measurements.parquet", dtype_backend="numpy_nullable"))
    expected = load_results(written.results).measurements
    assert len(rows) == len(expected) > 5
    for row, measurement in zip(rows, expected, strict=True):
        interval = measurement.interval
        for name in ("low", "high", "level", "method"):
            assert row.pop(name) == (None if interval is None else getattr(interval, name))
        assert tuple(row.pop("episodes").split()) == measurement.episodes
        assert row == {name: getattr(measurement, name) for name in row}
    assert any(row["value"] is None and row["reason_if_undefined"] for row in rows)


def test_every_field_has_a_column() -> None:
    assert list(OF_TRIALS) == [field.name for field in fields(TrialRecord)]
    assert len(OF_MEASUREMENTS) == 14


def take_away(monkeypatch: pytest.MonkeyPatch, package: str, user: str) -> None:
    """Make a package uninstalled, for the module that needs it."""
    for name in [name for name in sys.modules if name.startswith(user)]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(user, raising=False)
    monkeypatch.setattr(sys, "meta_path", [Missing(package), *sys.meta_path])
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)


def test_without_pyarrow_the_report_is_written_and_says_so(
    six_trials: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    take_away(monkeypatch, "pyarrow", "evaluator.report.parquet")
    comparison = compare_run(six_trials.run)
    text = summary_text(comparison.results(), write_report(comparison, six_trials.run.results_dir))
    assert "not written: pyarrow is not installed" in text
    assert (six_trials.run.results_dir / "trials.csv").is_file()
    assert not list(six_trials.run.results_dir.glob("*.parquet"))


class Missing:
    """An import finder that claims one package is not installed."""

    def __init__(self, package: str) -> None:
        """Remember the package."""
        self._package = package

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name.split(".")[0] == self._package:
            message = f"No module named {name!r}"
            raise ModuleNotFoundError(message, name=name)


def test_parquet_is_written_without_pandas_and_numbers_keep_their_last_bit(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; "
        "from bridge.exchange.trials_csv import TrialRecord; "
        "from evaluator.report.parquet import write_trials; "
        "trial = TrialRecord(trial_id='a', task='t', p_success=0.1 + 0.2); "
        "write_trials(Path(sys.argv[1]), [trial]); "
        "print('pandas' in sys.modules)"
    )
    path = tmp_path / "t.parquet"
    assert printed(code, str(path)) == "False"
    assert pd.read_parquet(path)["p_success"].tolist() == [0.1 + 0.2]


def test_no_measurement_is_a_table_without_rows(tmp_path: Path) -> None:
    frame = pd.read_parquet(write_measurements(tmp_path / "m.parquet", []))
    assert list(frame.columns) == list(OF_MEASUREMENTS)
    assert len(frame) == 0
