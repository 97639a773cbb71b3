"""What a figure is before anything draws it: its words and its colours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bridge.media import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMN_IN = 3.5
"""Width of a column of a paper [in]; every figure fits one."""

NAMES = {
    "soft": "quiet",
    "line": "edge",
    "sim": "twin-planned",
    "executed": "twin-executed",
    "rec": "recorded",
}
"""Short names of figures, and what they mean in the palette."""
LIGHT = {**palette.LIGHT, **{name: palette.LIGHT[meaning] for name, meaning in NAMES.items()}}
"""Colours of the files."""
DARK = {**palette.DARK, **{name: palette.DARK[meaning] for name, meaning in NAMES.items()}}
"""The same names on a dark page."""

ON_PAPER = {"facecolor": LIGHT["paper"], "edgecolor": "none", "pad": 0.8}
"""Box behind a label, so that no line runs through it."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure; what is drawn stands in the tables of the evaluation."""

    id: str
    """File name without its ending."""
    title: str
    caption: str
    """What the marks mean and what the figure does not say."""
    alt: str
    """What it shows, for someone who cannot see it."""
    height_in: float
    draw: Callable[["Figure"], None]
    width_in: float = COLUMN_IN


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """One figure, ready to be written."""

    drawing: Drawing
    svg: bytes
    """A file of its own, in the colours of print."""
    inline: str
    """For a page that defines the colours; its ids start with the figure's."""


@dataclass(frozen=True, kw_only=True)
class NotDrawn:
    """A figure without data."""

    id: str
    reason: str


def panel(
    figure: "Figure", *, left: float, bottom: float, right: float = 0.12, top: float = 0.12
) -> "Axes":
    """Add axes that leave these margins [in] to the edges of the figure."""
    width, height = figure.get_size_inches()
    return framed(figure, (left, bottom, float(width) - left - right, float(height) - bottom - top))


def framed(figure: "Figure", box_in: tuple[float, float, float, float]) -> "Axes":
    """Add axes at (left, bottom, width, height) [in] with two quiet spines.

    Args:
        box_in: Left and bottom edge from the figure's corner, width and height [in].
    """
    width, height = (float(side) for side in figure.get_size_inches())
    left, bottom, across, up = box_in
    axes = figure.add_axes((left / width, bottom / height, across / width, up / height))
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(LIGHT["soft"])
        axes.spines[side].set_linewidth(0.6)
    axes.tick_params(length=2.5, width=0.6, color=LIGHT["soft"], labelcolor=LIGHT["soft"])
    axes.patch.set_visible(False)
    axes.set_axisbelow(True)
    return axes


def grid(axes: "Axes", which: str = "both") -> None:
    """Draw hairlines behind the data."""
    axes.grid(visible=True, axis=which, color=LIGHT["line"], linewidth=0.6)  # type: ignore[arg-type]


def percent_axis(axes: "Axes", which: str, label: str) -> None:
    """Run an axis from 0 to 100 %, with room for marks at both ends."""
    name = f"{label} (%)"
    if which == "x":
        axes.set_xlim(-3, 103)
        axes.set_xticks(range(0, 101, 20))
        axes.set_xlabel(name)
    else:
        axes.set_ylim(-3, 103)
        axes.set_yticks(range(0, 101, 20))
        axes.set_ylabel(name)


LEGEND_LINE_IN = 0.155


def legend_columns(names: Sequence[str]) -> int:
    """How many names stand beside each other without leaving the figure."""
    return 2 if max((len(name) for name in names), default=0) <= 20 else 1


def legend(axes: "Axes", *, above_in: float = 0.05, columns: int = 2) -> None:
    """Put the legend above the axes, where no data can lie under it.

    Args:
        above_in: Distance from the upper edge of the axes [in].
    """
    height = axes.get_position().height * float(axes.figure.get_size_inches()[1])  # type: ignore[union-attr]
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0 + above_in / height),
        ncols=columns,
        frameon=False,
        borderaxespad=0.0,
        handlelength=1.4,
        columnspacing=1.2,
        handletextpad=0.5,
        labelspacing=0.3,
    )


def log_axis(axes: "Axes") -> None:
    """Make the x axis logarithmic, with plain numbers at 1, 2, 5."""
    from matplotlib.ticker import LogLocator  # noqa: PLC0415  # matplotlib is there when drawing

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()


def words(*parts: str) -> str:
    """Join names as a reader writes them."""
    return ", ".join(part.replace("_", " ") for part in parts if part)


def listed(names: Sequence[str], *, at_most: int = 6) -> str:
    """Name a few and count the rest."""
    shown = "; ".join(names[:at_most])
    more = len(names) - at_most
    return shown if more <= 0 else f"{shown}; and {more} more"
