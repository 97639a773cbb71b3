"""Figures: the same bytes every time, text as text, colours of the palette, words for each."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest

from evaluator.compare import Comparison, compare_csv
from evaluator.report.figures import DARK, LIGHT, WIDTH, Drawing, drawings_of, scatter
from evaluator.report.sections import FIGURES, SECTIONS
from evaluator.report.write import write_report

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


def test_a_figure_that_has_lost_its_data_is_removed(tmp_path: Path, paper: Comparison) -> None:
    write_report(paper, tmp_path)
    stale, mine = (tmp_path / "figures" / name for name in ("scatter.svg", "mine.svg"))
    assert stale.is_file()
    mine.write_text("<svg/>")
    write_report(replace(paper, groups=()), tmp_path)
    assert not stale.exists()
    assert mine.exists()
