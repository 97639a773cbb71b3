"""Every figure of a comparison, or why there is none."""

from collections.abc import Iterable, Sequence

from evaluator.compare.motion import MotionSummary
from evaluator.compare.plot_data import curve_bands
from evaluator.compare.rows import Comparison
from evaluator.memory import Packed
from evaluator.report.figures.distributions import (
    distributions,
    motions,
    state_panels,
    view_panels,
)
from evaluator.report.figures.drawing import Drawing, NotDrawn
from evaluator.report.figures.rates import gains, scatter, success

FIRST = ("recorded to planned", "recorded to executed")


def drawings_of(comparison: Comparison) -> tuple[list[Drawing], list[NotDrawn]]:
    """Return the figures that have data, in the order of the report, and the others."""
    groups, word = comparison.groups, comparison.recorded_word
    everything: tuple[Drawing | NotDrawn, ...] = (
        success(groups, word),
        scatter(groups, word),
        gains(comparison.measurements, word),
        motions(curve_bands(_curves(comparison.motions))),
        distributions(*state_panels(comparison.states)),
        distributions(*view_panels(comparison.views)),
    )
    drawn = [item for item in everything if isinstance(item, Drawing)]
    return drawn, [item for item in everything if isinstance(item, NotDrawn)]


def _curves(summaries: Iterable[MotionSummary]) -> dict[str, Sequence[Packed]]:
    """Gather curves by what was compared with what; planned comes before executed."""
    found: dict[str, list[Packed]] = {}
    for summary in summaries:
        name = f"{summary.side} to {summary.against}"
        found.setdefault(name, []).append(summary.curve_m)
    return {name: found[name] for name in sorted(found, key=lambda name: name not in FIRST)}
