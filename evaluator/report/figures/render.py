"""Draw figures with matplotlib: SVG files, and SVG that takes the colours of a page.

Importing this module loads matplotlib; the report does so only when it draws. Nothing depends on
the clock, on chance or on the fonts of the machine, so the same results give the same bytes.
"""

import io
import re
from html import escape
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from evaluator.report.figures.drawing import LIGHT, Drawing, Rendered

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
    "path.simplify": False,
}
_COLOURS = {value: name for name, value in LIGHT.items()}
_COLOUR = re.compile("|".join(_COLOURS))


def render(drawing: Drawing) -> Rendered:
    """Draw one figure as a file and for the page."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(drawing.width_in, drawing.height_in))
        drawing.draw(figure)
        svg = io.BytesIO()
        about = {"Title": drawing.title, "Creator": "robot-gst"}
        figure.savefig(svg, format="svg", metadata={**about, "Date": None})
    return Rendered(
        drawing=drawing,
        svg=svg.getvalue(),
        inline=_inline(svg.getvalue().decode(), drawing),
    )


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
