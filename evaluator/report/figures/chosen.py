"""Every figure of a comparison, or why there is none."""

from collections.abc import Iterable

from evaluator.compare.drawn import curve_bands, drawn_bins
from evaluator.compare.motion import MotionSummary
from evaluator.compare.rows import Comparison
from evaluator.report.figures.agreement import scatter, success
from evaluator.report.figures.bands import bands
from evaluator.report.figures.drawing import Drawing, NotDrawn
from evaluator.report.figures.gains import gains
from evaluator.report.figures.gate import confusion, costs, reliability
from evaluator.report.figures.spreads import distributions, motions
from evaluator.report.figures.stages import funnel
from evaluator.report.figures.states import state_panels
from evaluator.report.figures.views import view_panels


def drawings(comparison: Comparison) -> tuple[list[Drawing], list[NotDrawn]]:
    """Return the figures that have data, in the order of the report, and the others."""
    word = comparison.recorded_word
    everything: tuple[Drawing | NotDrawn, ...] = (
        success(comparison.cells, word),
        scatter(comparison.cells, word),
        gains(comparison.measurements, word),
        confusion(comparison.tables, word),
        costs(comparison.tables),
        reliability(drawn_bins(comparison.rows)),
        funnel(comparison.tables),
        motions(curve_bands(_curves(comparison.motions))),
        bands(comparison.bands),
        distributions(*state_panels(comparison.states)),
        distributions(*view_panels(comparison.views)),
    )
    drawn = [item for item in everything if isinstance(item, Drawing)]
    return drawn, [item for item in everything if isinstance(item, NotDrawn)]


def _curves(summaries: Iterable[MotionSummary]) -> dict[str, list[tuple[float, ...]]]:
    """Gather curves by what was compared with what; planned comes before executed."""
    found: dict[str, list[tuple[float, ...]]] = {}
    for summary in summaries:
        name = f"{summary.side} to {summary.against}"
        found.setdefault(name, []).append(summary.curve_m)
    return {name: found[name] for name in sorted(found, key=lambda name: name not in FIRST)}


FIRST = ("recorded to planned", "recorded to executed")
