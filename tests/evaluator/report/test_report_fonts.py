"""Fonts in PDF files: cut once for all figures, whole enough for each, and never lost."""

import re
import zlib
from typing import Any

import matplotlib as mpl
import pytest
from matplotlib.backends import _backend_pdf_ps as embedding
from matplotlib.figure import Figure

from evaluator.report.figures import render as render_module
from evaluator.report.figures.drawing import Drawing
from evaluator.report.figures.render import render
from evaluator.result import Table

TABLE = Table(id="t", title="", columns=("a",), rows=((1,),))


@pytest.fixture(autouse=True)
def no_cut_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_module, "_CUTS", {})


def saying(text: str) -> Drawing:
    def draw(figure: Any) -> None:
        figure.text(0.1, 0.5, text)

    return Drawing(id="t", title="T", caption="", alt="", table=TABLE, height_in=1.0, draw=draw)


def cuts_made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count how often a font is cut, without changing how it is."""
    made: list[int] = []
    original = embedding.get_glyphs_subset

    def counted(fontfile: Any, glyphs: Any) -> Any:
        made.append(len(glyphs))
        return original(fontfile, glyphs)

    monkeypatch.setattr(embedding, "get_glyphs_subset", counted)
    return made


def glyph_counts(pdf: bytes) -> list[int]:
    """How many glyphs each embedded font holds, read from its ``maxp`` table."""
    counts = []
    for match in re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL):
        try:
            data = zlib.decompress(match[1])
        except zlib.error:
            continue
        if data[:4] != b"\x00\x01\x00\x00":
            continue
        tables = int.from_bytes(data[4:6], "big")
        for place in range(12, 12 + 16 * tables, 16):
            if data[place : place + 4] == b"maxp":
                offset = int.from_bytes(data[place + 8 : place + 12], "big")
                counts.append(int.from_bytes(data[offset + 4 : offset + 6], "big"))
    return counts


def test_figures_with_usual_characters_share_one_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    made = cuts_made(monkeypatch)
    pdfs = [render(saying(text)).pdf for text in ("success (%)", "Twin -3.5 mm", "±0.1 × 2 − 1")]
    assert len(made) == 1, "matplotlib has changed inside: evaluator/report/figures/render.py"
    counts = {count for pdf in pdfs for count in glyph_counts(pdf)}
    assert len(counts) == 1
    assert min(counts) >= made[0]


def test_an_unusual_character_is_cut_too_and_changes_no_other_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = cuts_made(monkeypatch)
    before = render(saying("plain")).pdf
    usual = glyph_counts(before)[0]
    assert max(glyph_counts(render(saying("\u0416\u2603")).pdf)) == usual + 2
    assert made == [made[0], made[0] + 2]
    assert render(saying("plain")).pdf == before


def test_where_matplotlib_is_another_each_file_has_its_own_cut(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(render_module, "_WANTED", ("fontfile", "characters"))
    made = cuts_made(monkeypatch)
    pdfs = [render(saying(text)).pdf for text in ("abc", "xyz")]
    assert made == [3, 3]
    assert all(b"/CIDFontType2" in pdf for pdf in pdfs)


def test_nothing_of_it_stays_in_matplotlib() -> None:
    before = embedding.get_glyphs_subset, embedding.font_as_file
    render(saying("abc"))
    assert (embedding.get_glyphs_subset, embedding.font_as_file) == before
    with pytest.raises(RuntimeError, match="spoilt"), render_module.shared_cuts():
        raise RuntimeError("spoilt")
    assert (embedding.get_glyphs_subset, embedding.font_as_file) == before
    figure = Figure()
    assert figure is not None
    assert mpl.rcParams["pdf.fonttype"] == 3  # the user's own figures are left alone
