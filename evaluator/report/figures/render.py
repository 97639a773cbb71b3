"""Draw figures with matplotlib: SVG and PDF files, and SVG that takes the colours of a page.

Importing this module loads matplotlib; the report does so only when it draws. Nothing depends on
the clock, on chance or on the fonts of the machine, so the same results give the same bytes.
"""

import inspect
import io
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from html import escape
from typing import Any

import matplotlib as mpl
from matplotlib.backends import _backend_pdf_ps
from matplotlib.figure import Figure
from matplotlib.font_manager import get_font

from evaluator.report.figures.drawing import LIGHT, Drawing, Rendered

# matplotlib cuts out of the font what each PDF file needs, and fontTools takes longer for that than
# everything else in a figure. Here one cut with the usual characters is made and put into every
# file: ten kilobytes more in each. This reaches into matplotlib 3.11; where its insides are others,
# each file has its own cut as before, and only takes longer.

embedding: Any = _backend_pdf_ps

USUAL = "".join(map(chr, range(0x20, 0x7F))) + "°±²µ·×–—’…−≈≤≥→"
"""In every cut, so that figures share it; what else a figure writes is cut for it alone."""
_WANTED = ("fontfile", "glyphs")


@dataclass(frozen=True, kw_only=True)
class Cut:
    """A part of a font, as it is embedded: what matplotlib wants of it."""

    font: bytes
    glyph_index_map: dict[int, int]
    """From places in the whole font to places in the cut."""


@contextmanager
def shared_cuts() -> Iterator[None]:
    """Let PDF files that are written meanwhile share the cuts of this process."""
    original = getattr(embedding, "get_glyphs_subset", None)
    save = getattr(embedding, "font_as_file", None)
    if not (callable(original) and callable(save) and _is_known(original)):
        yield
        return

    def shared(fontfile: Any, glyphs: Iterable[int]) -> AbstractContextManager[Cut]:
        wanted = _usual_glyphs(fontfile) | frozenset(glyphs)
        if (fontfile, wanted) not in _CUTS:
            with original(fontfile, set(wanted)) as found:
                _CUTS[fontfile, wanted] = Cut(
                    font=save(found.font).getvalue(), glyph_index_map=found.glyph_index_map
                )
        return nullcontext(_CUTS[fontfile, wanted])

    embedding.get_glyphs_subset, embedding.font_as_file = shared, io.BytesIO
    try:
        yield
    finally:
        embedding.get_glyphs_subset, embedding.font_as_file = original, save


_CUTS: dict[tuple[Any, frozenset[int]], Cut] = {}
"""By font file and what is in the cut, so that a file does not depend on what was drawn before."""


def _is_known(function: Callable[..., Any]) -> bool:
    return tuple(inspect.signature(function).parameters) == _WANTED


@cache
def _usual_glyphs(fontfile: Any) -> frozenset[int]:
    font = get_font(fontfile)
    return frozenset(font.get_char_index(ord(letter)) for letter in USUAL) - {0}


PX_PER_IN = 126
"""A figure's width on the page: 8 pt text becomes 14 px."""

STYLE: dict[Any, Any] = {
    "font.family": ["sans-serif"],
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib
    "font.size": 8.0,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.0,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5,
    "axes.labelcolor": LIGHT["ink"],
    "text.color": LIGHT["ink"],
    "axes.unicode_minus": True,
    "axes.formatter.useoffset": False,
    "lines.markersize": 4.0,
    "lines.linewidth": 1.4,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "robot-gst",
    "pdf.fonttype": 42,
    "pdf.use14corefonts": False,
    "path.simplify": False,
}
_COLOURS = {value: name for name, value in LIGHT.items()}
_COLOUR = re.compile("|".join(_COLOURS))


def render(drawing: Drawing) -> Rendered:
    """Draw one figure in all forms."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(drawing.width_in, drawing.height_in))
        drawing.draw(figure)
        svg, pdf = io.BytesIO(), io.BytesIO()
        about = {"Title": drawing.title, "Creator": "robot-gst"}
        figure.savefig(svg, format="svg", metadata={**about, "Date": None})
        undated = {"CreationDate": None, "Producer": None}
        with shared_cuts():
            figure.savefig(pdf, format="pdf", metadata={**about, **undated})
    return Rendered(
        drawing=drawing,
        svg=svg.getvalue(),
        pdf=pdf.getvalue(),
        inline=_inline(svg.getvalue().decode(), drawing),
    )


def warm_up() -> None:
    """Load what the first figure would: fonts, writers of both kinds, a cut of the font."""
    with mpl.rc_context(STYLE):
        figure = Figure()
        figure.add_subplot().text(0.5, 0.5, "%")
        figure.savefig(io.BytesIO(), format="svg")
        with shared_cuts():
            figure.savefig(io.BytesIO(), format="pdf")


def _inline(svg: str, drawing: Drawing) -> str:
    """Turn the file into part of a page: its colours, its font, ids of its own, and a name."""
    body = svg[svg.index("<svg") :]
    box = re.search(r'viewBox="([^"]+)"', body)
    inner = body[body.index(">") + 1 : body.rindex("</svg>")]
    inner = re.sub(r"<metadata>.*?</metadata>", "", inner, flags=re.DOTALL)
    inner = re.sub(r"<style[^>]*>.*?</style>", "", inner, flags=re.DOTALL)
    inner = re.sub(r"<!--.*?-->", "", inner, flags=re.DOTALL)
    inner = _COLOUR.sub(lambda found: f"var(--{_COLOURS[found[0]]})", inner)
    inner = re.sub(r"font: ([\d.]+px)[^;\"]*", r"font: \1 var(--figure-font)", inner)
    name = drawing.id
    inner = re.sub(r'\bid="', f'id="{name}-', inner)
    inner = re.sub(r'xlink:href="#', f'href="#{name}-', inner)
    inner = inner.replace("url(#", f"url(#{name}-")
    width = round(PX_PER_IN * drawing.width_in)
    height = round(PX_PER_IN * drawing.height_in)
    return (
        f'<svg class="fig" viewBox="{box[1] if box else ""}" width="{width}" height="{height}" '
        f'role="img" aria-labelledby="{name}-title {name}-alt">'
        f'<title id="{name}-title">{escape(drawing.title)}</title>'
        f'<desc id="{name}-alt">{escape(drawing.alt)}</desc>'
        f'<g aria-hidden="true">{re.sub(chr(10) + " *", chr(10), inner).strip()}</g></svg>'
    )
