"""LaTeX tables: a grammar holds whatever a cell says, and TeX compiles them where there is one."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluator.compare import compare_csv
from evaluator.report.methods import methods
from evaluator.report.tables import LONG_ROWS, as_latex, caption_of, latex
from evaluator.report.write import write_report
from evaluator.result import Table

PAPER = Path(__file__).resolve().parents[3] / "docs" / "examples" / "paper_table_rates.csv"
TEX = shutil.which("pdflatex") or shutil.which("lualatex") or shutil.which("tectonic")
NASTY = (
    "[x]",
    "*",
    "50 %",
    "a_b & c",
    "#1 $2 {3}",
    "~^\\",
    "<b>",
    'say "so"',
    "≥ 3 °",
    "名",
    "a\nb",
)
TOKEN = re.compile(
    r"\\(?:[A-Za-z]+|[\\&%$#_{}])"  # a command
    r"|[{}]"
    r"|\$(?:[^$\\]|\\[A-Za-z]+)*\$"  # a little mathematics
    r"|&"
    r"|%\n"  # the end of a line that is no blank
    r"|[^\\{}$&#_%^~]"  # plain text
)


def tokens(text: str) -> list[str]:
    """Split LaTeX; anything the grammar does not know ends the test."""
    found, place = [], 0
    while place < len(text):
        match = TOKEN.match(text, place)
        assert match is not None, text[max(0, place - 20) : place + 20]
        found.append(match[0])
        place = match.end()
    return found


def check(text: str, columns: int, rows: int) -> None:
    """Braces and environments are balanced, and every line has its cells."""
    depth = 0
    for token in tokens(text):
        depth += {"{": 1, "}": -1}.get(token, 0)
        assert depth >= 0
    assert depth == 0
    opened: list[str] = []
    for kind, name in re.findall(r"\\(begin|end)\{([a-z*]+)\}", text):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    body = text[text.index(r"\midrule") :].splitlines()
    lines = [line for line in body if line.endswith(r" \\")]
    assert len(lines) == rows
    for line in lines:
        assert len(re.findall(r"(?<!\\)&", line)) == columns - 1
        assert not re.match(r"\s*[\[*]", line)  # it would be the argument of the line before


def table(rows: list[tuple[str, ...]], note: str = "") -> Table:
    columns = tuple(f"column {index}_%" for index in range(len(rows[0])))
    return Table(id="t_1", title="T & co_1", columns=columns, rows=tuple(rows), note=note)


def test_nasty_cells_stay_text() -> None:
    made = as_latex(table([(text, "1") for text in NASTY], note="100 % [sic]"))
    check(made, columns=2, rows=len(NASTY))
    assert "U+540D" in made
    assert made.count(r"\toprule") == made.count(r"\bottomrule") == 1


@given(st.lists(st.tuples(st.text(max_size=12), st.text(max_size=12)), min_size=1, max_size=4))
def test_any_text_is_escaped(rows: list[tuple[str, str]]) -> None:
    kept = [("x", *row) for row in rows]
    used = 1 + sum(any(row[i] for row in rows) for i in range(2))
    check(as_latex(table(kept)), columns=used, rows=len(rows))


def test_a_long_table_runs_over_pages_and_a_wide_one_is_shrunk() -> None:
    long = as_latex(table([("a", str(i)) for i in range(LONG_ROWS + 1)]))
    check(long, columns=2, rows=LONG_ROWS + 1)
    assert r"\begin{longtable}" in long
    assert r"\endhead" in long
    wide = as_latex(table([("a" * 60, "b" * 60)]))
    check(wide, columns=2, rows=1)
    assert r"\resizebox{\textwidth}" in wide


def test_numbers_stand_at_the_right_and_empty_columns_are_left_out() -> None:
    made = as_latex(
        Table(id="t", title="t", columns=("a", "b", "c"), rows=(("x", None, 1.5), ("y", "", 2)))
    )
    assert r"\begin{tabular}{@{}lr@{}}" in made
    assert latex("−0.5 ± 1") == r"$-$0.5 $\pm$ 1"


@pytest.mark.slow
@pytest.mark.skipif(TEX is None, reason="no TeX (Debian: texlive-latex-recommended)")
def test_tex_sets_the_tables(tmp_path: Path) -> None:
    assert TEX is not None
    tables = [
        table([(text, "1") for text in NASTY], note="100 % [sic]"),
        table([("a", str(i)) for i in range(60)]),
        table([("a" * 60, "b" * 60)]),
        table([(chr(code), "1") for code in range(0xA1, 0x180)]),
        *compare_csv(PAPER).tables,
    ]
    results = compare_csv(PAPER).results()
    paragraph, bib = methods(results)
    (tmp_path / "references.bib").write_text(bib)
    packages = r"\usepackage{booktabs,graphicx,longtable,threeparttable}"
    body = "\n".join(as_latex(item) for item in tables) + f"\n{paragraph}"
    text = f"\\documentclass{{article}}{packages}\\begin{{document}}{body}\\end{{document}}\n"
    typeset(text, tmp_path)


def typeset(text: str, folder: Path) -> str:
    """Set a document and return what TeX says."""
    assert TEX is not None
    (folder / "all.tex").write_text(text)
    options = [] if "tectonic" in TEX else ["-interaction=nonstopmode", "-halt-on-error"]
    done = subprocess.run(
        [TEX, *options, "all.tex"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:]
    return done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.skipif(TEX is None, reason="no TeX (Debian: texlive-latex-recommended)")
def test_nothing_reaches_over_a_column_of_a_paper(tmp_path: Path) -> None:
    write_report(compare_csv(PAPER), tmp_path)
    written = sorted(tmp_path.glob("tables/*.tex")) + sorted(tmp_path.glob("figures/*.tex"))
    body = "".join(rf"\input{{{path.relative_to(tmp_path)}}}" for path in written)
    assert r"\input{figures/scatter.tex}" in body
    packages = r"\usepackage{booktabs,graphicx,longtable,threeparttable}"
    text = f"\\documentclass[twocolumn]{{article}}{packages}\\begin{{document}}{body}"
    said = typeset(f"{text}\\end{{document}}\n", tmp_path)
    assert "Overfull" not in said, said


def test_a_wide_table_spans_both_columns_and_notes_belong_to_the_table() -> None:
    narrow, wide = table([("a", "1")], note="said below"), table([("a" * 30, "b" * 30)], note="n")
    made, spanning = as_latex(narrow), as_latex(wide)
    check(made, columns=2, rows=1)
    check(spanning, columns=2, rows=1)
    assert made.startswith(r"\begin{table}[t]")
    assert spanning.startswith(r"\begin{table*}[t]")
    for text in (made, spanning):
        notes = text.index(r"\begin{tablenotes}")
        assert text.index(r"\end{tabular}") < notes < text.index(r"\end{threeparttable}")


def test_a_caption_says_over_what_and_which_intervals() -> None:
    comparison = compare_csv(PAPER)
    (success,) = (t for t in comparison.tables if t.id == "success")
    assert caption_of(success) == (
        "Success over 3 tasks and 2 conditions. Brackets: 95 % intervals (Wilson)."
    )


def test_a_caption_counts_tasks_and_no_averages() -> None:
    tables = {table.id: table for table in compare_csv(PAPER).tables}
    assert "over 3 tasks." in caption_of(tables["layout"])
    for name in ("gains", "conclusions"):
        assert "over 3 tasks" in caption_of(tables[name])


def test_points_are_printed_to_a_tenth_with_their_interval() -> None:
    (table,) = (table for table in compare_csv(PAPER).tables if table.id == "conclusions")
    made = as_latex(table)
    assert re.search(r" pp", made)
    assert not re.search(r"\d\.\d{2}", made), made


def test_hyphens_stay_hyphens_and_a_minus_is_one() -> None:
    assert latex("--goal 0.8") == r"-{}-goal 0.8"
    assert latex("a---b") == "a-{}-{}-b"
    assert latex("-33.3") == "$-$33.3"
    assert latex("+75 pp [-50.5, +98.3]") == "+75 pp {[}$-$50.5, +98.3{]}"
    assert latex("2026-11-22, f-5, clopper-pearson") == "2026-11-22, f-5, clopper-pearson"
    made = as_latex(Table(id="t", title="t", columns=("a",), rows=((-1.5,), (2,))))
    check(made, columns=1, rows=2)
    assert r"$-$1.5 \\" in made


def test_a_sentence_is_broken_over_lines_and_a_long_wide_table_is_set_smaller() -> None:
    sentence = "few points that rise together give a high r, whatever the twin is like"
    made = as_latex(table([("r", sentence), ("gain", "a short one")]))
    check(made, columns=2, rows=2)
    assert r"\begin{tabular}{@{}lp{0.60\textwidth}@{}}" in made
    assert r"\resizebox" not in made  # it was shrunk until nobody could read it
    long = as_latex(table([("a" * 60, "b" * 60)] * (LONG_ROWS + 1)))
    check(long, columns=2, rows=LONG_ROWS + 1)
    assert r"{\tiny\setlength{\tabcolsep}{2pt}" in long


@pytest.mark.parametrize(
    ("title", "caption"),
    [
        ("Ranking of 2 policies", "Ranking of 2 policies."),
        ("Success", "Success over 2 policies."),
    ],
)
def test_a_caption_counts_nothing_twice(title: str, caption: str) -> None:
    table = Table.of([{"policy": "a"}, {"policy": "b"}], id="t", title=title)
    assert caption_of(table) == caption
