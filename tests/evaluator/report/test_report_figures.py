"""Figures: the same bytes every time, text as text, colours of the palette, words for each."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import lean_checks
import pytest

from evaluator.compare import Comparison, compare_csv
from evaluator.report.figures.drawing import DARK, LIGHT, Drawing, NotDrawn, Rendered
from evaluator.report.figures.rates import scatter, success
from evaluator.report.figures.render import render
from evaluator.report.figures.selection import drawings_of
from evaluator.report.ranked import FIGURES
from evaluator.report.sections import SECTIONS
from evaluator.report.write import write_report

PAPER = Path(__file__).resolve().parents[3] / "docs" / "examples" / "paper_table_rates.csv"
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def rendered(everything: Comparison) -> list[Rendered]:
    drawn, not_drawn = drawings_of(everything)
    assert [item.id for item in not_drawn] == []
    with lean_checks.unchecked():
        return [render(drawing) for drawing in drawn]


def test_a_run_with_everything_has_every_figure_and_each_has_its_place(
    rendered: list[Rendered],
) -> None:
    placed = [name for section in SECTIONS for name in section.figures]
    assert sorted(item.drawing.id for item in rendered) == sorted(placed)
    assert len(placed) == len(set(placed)) == 6
    assert set(placed) == FIGURES.keys()


def test_what_has_no_data_is_named_with_its_reason() -> None:
    drawn, not_drawn = drawings_of(compare_csv(PAPER))
    assert {item.id for item in drawn} == {"scatter", "success", "gains"}
    assert {item.id for item in not_drawn} == {"motions", "states", "views"}
    assert all(item.reason for item in not_drawn)


def test_drawing_twice_gives_the_same_bytes(rendered: list[Rendered]) -> None:
    for item in rendered[:3]:
        again = render(item.drawing)
        assert again.svg == item.svg
        assert b"Date" not in item.svg


def test_files_are_well_formed_and_their_text_can_be_selected(rendered: list[Rendered]) -> None:
    for item in rendered:
        root = ET.fromstring(item.svg)
        texts = [text.text or "" for text in root.iter(f"{SVG}text")]
        assert len(texts) > 4, item.drawing.id
        assert not list(root.iter(f"{SVG}image"))
        assert len(item.svg) < 200_000


def test_pages_take_figures_in_their_own_colours(rendered: list[Rendered]) -> None:
    ids: list[str] = []
    for item in rendered:
        assert not re.search(r"#[0-9a-f]{6}\b", item.inline), item.drawing.id
        named = set(re.findall(r"var\(--([a-z]+)\)", item.inline))
        assert named <= LIGHT.keys(), item.drawing.id
        root = ET.fromstring(item.inline)
        ids += [element.get("id") or "" for element in root.iter() if element.get("id")]
        used = re.findall(r'(?:href="#|url\(#)([^")]+)', item.inline)
        assert set(used) <= set(ids)
    assert len(ids) == len(set(ids))
    assert LIGHT.keys() == DARK.keys()
    pairs = {(LIGHT[name], DARK[name]) for name in LIGHT}
    assert len(pairs) == len(set(LIGHT.values()))  # a page may tell a name by its colour on paper


def test_figures_have_words_for_those_who_cannot_see_them(rendered: list[Rendered]) -> None:
    for item in rendered:
        drawing = item.drawing
        root = ET.fromstring(item.inline)
        assert root.get("role") == "img"
        assert len(drawing.alt) > 40
        assert root.findtext("desc") == drawing.alt


def test_the_papers_cells_stand_in_the_words_of_the_scatter() -> None:
    drawing = scatter(compare_csv(PAPER).groups, "real")
    assert isinstance(drawing, Drawing)
    pairs = re.findall(r"twin (\S+(?: %)?), real ([^;]+)", drawing.alt)
    found = sorted((_percent(sim), _percent(real)) for sim, real in pairs)
    assert found == sorted([(80, 80), (100, 90), (60, 40), (100, 80), (60, 46), (80, 70)])


def _percent(text: str) -> float:
    k, _, n = text.strip(". ").removesuffix(" %").partition("/")
    return 100 * float(k) / float(n) if n else float(k)


def test_there_is_no_figure_without_cells() -> None:
    assert isinstance(scatter([], "real"), NotDrawn)
    assert isinstance(success([], "real"), NotDrawn)


def test_a_figure_that_has_lost_its_data_is_removed(tmp_path: Path) -> None:
    stale = tmp_path / "figures" / "funnel.svg"
    stale.parent.mkdir()
    stale.write_text("<svg/>")
    (tmp_path / "results.json").write_text('{"tables": []}')
    mine = tmp_path / "figures" / "mine.svg"
    mine.write_text("<svg/>")
    written = write_report(compare_csv(PAPER), tmp_path)
    assert not stale.exists()
    assert mine.exists()
    assert any("motions (" in text for text in written.content.missing)
