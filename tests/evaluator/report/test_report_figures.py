"""Figures and Parquet: the same bytes, what CSV and JSON say; the page of a large run is small."""

import re
import sys
import xml.etree.ElementTree as ET
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from own_process import printed

from bridge.episode.run_folder import RunFolder
from bridge.exchange.trials_csv import TrialRecord, read_trials
from evaluator.compare import Comparison, compare_csv, compare_run
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.rows import TrialRow
from evaluator.report.figures import DARK, LIGHT, WIDTH, Drawing, drawings_of, scatter
from evaluator.report.page import SHOWN_ROWS
from evaluator.report.parquet import OF_MEASUREMENTS, OF_TRIALS, write_measurements, write_trials
from evaluator.report.sections import FIGURES, SECTIONS
from evaluator.report.write import Written, summary_text, write_report
from evaluator.result import load_results

PAPER = Path(__file__).resolve().parents[3] / "docs" / "examples" / "paper_table_rates.csv"
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def drawn(everything: Comparison) -> list[Drawing]:
    return drawings_of(everything)


@pytest.fixture(scope="module")
def paper() -> Comparison:
    return compare_csv(PAPER)


def test_each_figure_has_its_place_and_decides_something(drawn: list[Drawing]) -> None:
    placed = [name for section in SECTIONS for name in section.figures]
    assert sorted(item.id for item in drawn) == sorted(placed) == sorted(FIGURES)


def test_files_are_well_formed_and_their_text_can_be_selected(
    drawn: list[Drawing], everything: Comparison
) -> None:
    for item, again in zip(drawn, drawings_of(everything), strict=True):
        assert item.svg == again.svg
        root = ET.fromstring(item.svg)
        assert len([text for text in root.iter(f"{SVG}text") if text.text]) > 4, item.id
        assert not list(root.iter(f"{SVG}image"))
        assert "{" not in re.sub(r"<style>.*?</style>", "", item.svg)
        assert len(item.svg) < 200_000


def test_pages_take_figures_in_their_own_colours(drawn: list[Drawing]) -> None:
    ids: list[str] = []
    for item in drawn:
        assert not re.search(r"#[0-9a-f]{6}\b", item.inline), item.id
        assert set(re.findall(r"var\(--([a-z]+)\)", item.inline)) <= LIGHT.keys(), item.id
        root = ET.fromstring(item.inline)
        ids += [element.get("id") or "" for element in root.iter() if element.get("id")]
        assert root.get("role") == "img"
        assert root.findtext("desc") == item.alt
        assert len(item.alt) > 40
    assert len(ids) == len(set(ids))
    assert LIGHT.keys() == DARK.keys()


def test_the_marks_stand_where_the_rates_say(paper: Comparison) -> None:
    drawing = scatter(paper.groups, "real")
    assert drawing is not None
    root = ET.fromstring(drawing.svg)
    grid = list(root.iter(f"{SVG}line"))[:5]  # 0, 25, 50, 75 and 100 %
    left, right = (float(line.get("x1") or 0) for line in (grid[0], grid[4]))
    high, low = (float(grid[0].get(name) or 0) for name in ("y1", "y2"))
    found = {
        mark.findtext(f"{SVG}title"): (
            (float(mark.get("cx") or 0) - left) / (right - left),
            (low - float(mark.get("cy") or 0)) / (low - high),
        )
        for mark in root.iter(f"{SVG}circle")
    }
    assert len(found) == 6
    for group in paper.groups:
        sim, real = (rate.value or 0.0 for rate in group.pair)
        assert found[group.label] == (pytest.approx(sim, abs=0.03), pytest.approx(real, abs=0.03))


def test_the_papers_cells_stand_in_the_words_of_the_scatter(paper: Comparison) -> None:
    drawing = scatter(paper.groups, "real")
    assert drawing is not None
    pairs = re.findall(r"twin (\S+(?: %)?), real ([^;]+)", drawing.alt)
    found = sorted((_percent(sim), _percent(real)) for sim, real in pairs)
    assert found == sorted([(80, 80), (100, 90), (60, 40), (100, 80), (60, 46), (80, 70)])


def _percent(text: str) -> float:
    k, _, n = text.strip(". ").removesuffix(" %").partition("/")
    return 100 * float(k) / float(n) if n else float(k)


def test_nothing_is_drawn_beyond_the_edge(drawn: list[Drawing]) -> None:
    for item in drawn:
        for mark in ET.fromstring(item.svg).iter():
            for name, most in (("x", WIDTH), ("x1", WIDTH), ("x2", WIDTH), ("cx", WIDTH)):
                assert 0 <= float(mark.get(name) or 0) <= most, (item.id, ET.tostring(mark))
            for name in ("y", "y1", "y2", "cy"):
                assert 0 <= float(mark.get(name) or 0) <= item.height


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


MAX_BYTES = 5_000_000


def many(count: int) -> Comparison:
    """Draw trials of four tasks, with everything a trial row can say."""
    rng = np.random.default_rng(3)
    rows = []
    for number in range(count):
        recorded, said = bool(rng.random() < 0.6), bool(rng.random() < 0.7)
        condition = "with_replanning" if number % 2 else "without_replanning"
        rows.append(
            TrialRow(
                episode=f"monday-trial-{number:05d}",
                task=f"task_{number // 2 % 4}",
                condition=condition,
                policy="scripted",
                start_id=f"s{number // 2}",
                cell="standin",
                stand_in=True,
                recorded=recorded,
                sim_planned=said,
                sim_executed=recorded,
                verdict=said,
                p_success=float(rng.random()),
                first_failing=None if said else "clearance",
                failing_detail=None if said else "collision, gripper and box, at 1.40 s",
                stages=(("grasp", recorded or said), ("place", recorded)),
            )
        )
    return compare_rows(rows, run="large", source="run", stand_in=True)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_a_report_about_thousands_of_trials_stays_small_and_complete(tmp_path: Path) -> None:
    written = write_report(many(3000), tmp_path)
    text = written.report.read_text()
    assert len(text.encode()) < MAX_BYTES
    assert (
        f"The first {SHOWN_ROWS} of 3,000 rows; the whole is in trials.csv and trials.parquet"
        in text
    )
    assert "monday-trial-00199" in text
    assert "monday-trial-00200<" not in text
    lines = (tmp_path / "trials.csv").read_text().splitlines()
    assert len(lines) == 3001
    results = load_results(written.results)
    assert results == written.content
    assert len(results.get("agreement.sim_planned.rate").episodes) == 3000
    assert written.results.stat().st_size < 3_000_000
