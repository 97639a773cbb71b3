"""Tables, figures and the page: complete, escaped, self-contained, and honest about stand-ins."""

import contextlib
import csv
import html
import io
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.terminal import Output
from evaluator.cli import evaluate
from evaluator.compare import compare_csv, compare_run
from evaluator.report import sections
from evaluator.report.page import page
from evaluator.report.tables import as_csv, as_latex, as_text
from evaluator.report.write import write_report
from evaluator.result import Measurement, Results, Table, load_results

PAPER = Path(__file__).resolve().parents[3] / "docs" / "examples" / "paper_table_rates.csv"
HOSTILE = "<script>alert('&\"')</script>"
TABLE = Table(
    id="t",
    title="T_1 & co",
    columns=("task", "50 %"),
    rows=(("a|b_{c}", 1.5), (HOSTILE, None)),
    note="n",
)


class Tags(HTMLParser):
    """Collect tags and every address the page names."""

    def __init__(self) -> None:
        """Start empty."""
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "action", "data")]


class Evaluated(NamedTuple):
    """Six trials, once through the command."""

    run: RunFolder
    code: int
    shown: str

    @property
    def page(self) -> str:
        return (self.run.results_dir / "report.html").read_text()


@pytest.fixture(scope="module")
def evaluated(six_trials_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    folder = tmp_path_factory.mktemp("evaluated") / "monday"
    run = RunFolder(shutil.copytree(six_trials_once, folder))
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        code = evaluate(run.path, fail_under=0.8)
    return Evaluated(run, code, shown.getvalue())


def test_the_page_asks_for_nothing_outside_and_runs_nothing(evaluated: Evaluated) -> None:
    text = evaluated.page
    parsed = Tags()
    parsed.feed(text)
    assert parsed.addresses
    assert all(re.match(r"#|data:image/png;base64,", address) for address in parsed.addresses)
    assert "script" not in parsed.tags
    assert "@import" not in text
    assert not re.search(r"url\((?!#)", text)
    assert "http" not in re.sub(r"http-equiv", "", text)


def test_what_a_stranger_wrote_is_escaped_everywhere() -> None:
    results = Results(
        run=HOSTILE,
        source="run",
        stand_in=False,
        measurements=(
            Measurement(
                id="x", value=None, unit="1", definition=HOSTILE, reason_if_undefined=HOSTILE
            ),
        ),
        tables=(TABLE,),
        missing=(HOSTILE,),
        provenance={"x": HOSTILE},
    )
    parsed = Tags()
    text = page(results, everything=True)
    parsed.feed(text)
    assert "script" not in parsed.tags
    assert text.count("&lt;script&gt;") >= 6


def test_stand_in_results_carry_the_banner_and_never_the_word_real(evaluated: Evaluated) -> None:
    text = evaluated.page
    assert 'class="banner"' in text
    body = re.sub(r"not from a real robot", "", text)
    assert not re.search(r"\breal\b", body)


def test_results_of_a_real_cell_carry_no_banner() -> None:
    assert 'class="banner"' not in page(compare_csv(PAPER).results())


def test_a_table_is_the_same_in_every_form() -> None:
    rows = list(csv.reader(io.StringIO(as_csv(TABLE))))
    assert rows == [["task", "50 %"], ["a|b_{c}", "1.5"], [HOSTILE, ""]]
    latex = as_latex(TABLE)
    assert r"a|b\_\{c\} & 1.5 \\" in latex
    assert r"50 \%" in latex
    assert r"\caption{T\_1 \& co}" in latex
    assert latex.count(r"\begin") == latex.count(r"\end") == 2
    assert "a|b_{c}" in as_text(TABLE)
    assert "–" in as_text(TABLE)


def test_evaluate_writes_everything_and_says_where(evaluated: Evaluated) -> None:
    run, code, shown = evaluated
    assert code == 0
    assert "5/6 = 83.3 %" in shown
    assert "undefined: 2 groups; it needs at least 3" in shown
    assert "Stand-in:" in shown
    assert load_results(run.path).get("agreement.sim_planned.rate").k == 5
    for name in ("report.html", "trials.csv", "figures/success.svg", "tables/success.csv"):
        assert (run.results_dir / name).is_file()
    assert not list(run.results_dir.rglob("*.part"))
    kept = [path for path in run.results_dir.rglob("*") if path.is_file()]
    assert len([path for path in kept if path.parent.name != "cache"]) <= 30


@pytest.mark.usefixtures("unchecked")
def test_evaluate_prints_json_that_is_the_results_file(
    six_trials: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(six_trials.run.path, output=Output(json=True)) == 0
    record = json.loads(capsys.readouterr().out)
    assert record == json.loads((six_trials.run.results_dir / "results.json").read_text())


def test_a_run_without_trials_still_gets_a_report(
    maker: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    with EpisodeWriter(maker.run.episodes_dir / "scan.mcap") as writer:
        writer.describe(EpisodeInfo(id="scan", kind="scan"))
    assert evaluate(maker.run.path) == 0
    assert "the run holds no recorded trial" in capsys.readouterr().out
    assert "no recorded trial" in (maker.run.results_dir / "report.html").read_text()


@pytest.mark.usefixtures("unchecked")
def test_writing_twice_replaces_the_first(six_trials: Any) -> None:
    comparison = compare_run(six_trials.run)
    folder = six_trials.run.results_dir
    before = {path: path.read_bytes() for path in write_report(comparison, folder).files}
    second = write_report(compare_run(six_trials.run), folder)
    assert {path: path.read_bytes() for path in second.files} == before


def test_what_an_earlier_evaluation_wrote_and_this_one_does_not_is_removed(
    six_trials: Any, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    write_report(compare_run(six_trials.run), out, everything=True, latex=True)
    mine = out / "tables" / "mine.tex"
    mine.write_text("not ours")
    assert (out / "trials.csv").is_file()
    assert (out / "tables" / "confusion.tex").is_file()
    written = write_report(compare_csv(PAPER), out)
    assert mine.read_text() == "not ours"
    left = {path for path in out.rglob("*") if path.is_file()} - {mine, written.results}
    assert left == set(written.files)
    assert not (out / "trials.csv").exists()
    assert not (out / "trials.parquet").exists()


def test_a_report_shows_what_somebody_decides_by_and_all_of_it_when_asked(
    six_trials: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sections, "MOST_TABLES", 4)
    comparison = compare_run(six_trials.run)
    text = html.unescape(write_report(comparison, tmp_path).report.read_text())
    shown = {path.stem for path in (tmp_path / "tables").iterdir()}
    assert len(shown) == 4
    assert shown < {table.id for table in comparison.tables}
    for name in shown:
        assert f"To decide {sections.decides(name)}." in text
    everything = write_report(comparison, tmp_path, everything=True)
    assert {path.stem for path in (tmp_path / "tables").iterdir()} == {
        table.id for table in everything.content.tables
    }
    assert comparison.measurements[0].definition in html.unescape(everything.report.read_text())


@pytest.mark.parametrize("width", [40, 60, 80, 120, 200])
def test_a_table_fits_the_terminal_and_no_word_is_broken(width: int) -> None:
    conditions = ("without replanning", "with replanning")
    table = Table(
        id="any",
        title="A table",
        columns=("task", "condition", "policy", "unit", "rate", "why"),
        rows=tuple(
            (
                "five_ducks_into_basket",
                condition,
                "scripted",
                "trial",
                "3/10 = 30.0 % [10.8, 60.3]",
                f"undefined: {reason}",
            )
            for condition, reason in zip(conditions, ("too few trials", ""), strict=True)
        ),
        note="A note that is longer than a narrow terminal is wide, and says so.",
    )
    text = as_text(table, width=width)
    assert max(map(len, text.splitlines())) <= width
    words = text.split()
    for cell in (table.title, table.note, *table.columns, *(c for row in table.rows for c in row)):
        for word in cell.split():
            assert any(word in shown for shown in words), word
