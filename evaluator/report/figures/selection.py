"""Every figure of a comparison, or why there is none."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from evaluator.compare.band_measurements import BandCurve
from evaluator.compare.motion import MotionSummary
from evaluator.compare.plot_data import CurveBand, ReliabilityPoint, curve_bands, reliability_points
from evaluator.compare.rows import Comparison, RateGroup
from evaluator.memory import Packed
from evaluator.report.figures.distributions import (
    Panel,
    Subject,
    bands,
    distributions,
    motions,
    state_panels,
    view_panels,
)
from evaluator.report.figures.drawing import Drawing, NotDrawn
from evaluator.report.figures.gate import confusion, costs, reliability
from evaluator.report.figures.order import session_order
from evaluator.report.figures.rates import funnel, gains, scatter, success
from evaluator.report.figures.tasks import tasks
from evaluator.result import Measurement, Table


@dataclass(frozen=True, kw_only=True)
class Drawable:
    """What the figures of a comparison are made of: little, however many trials it rests on."""

    word: str
    """What the recorded side is called."""
    groups: tuple[RateGroup, ...]
    """Without the episodes they rest on, as the gains."""
    gains: tuple[Measurement, ...]
    tables: tuple[Table, ...]
    bins: tuple[ReliabilityPoint, ...]
    motions: tuple[CurveBand, ...]
    bands: tuple[BandCurve, ...]
    distributions: tuple[tuple[Subject, tuple[Panel, ...]], ...]


def drawable(comparison: Comparison) -> Drawable:
    """Gather what the figures show."""
    gained = [m for m in comparison.measurements if m.id.startswith("gain.")]
    panels = (state_panels(comparison.states), view_panels(comparison.views))
    return Drawable(
        word=comparison.recorded_word,
        groups=tuple(_group_alone(group) for group in comparison.groups),
        gains=tuple(_alone(measurement) for measurement in gained),
        tables=tuple(table for table in comparison.tables if table.id in TABLES),
        bins=tuple(reliability_points(comparison.rows)),
        motions=tuple(curve_bands(_curves(comparison.motions))),
        bands=comparison.bands,
        distributions=tuple((subject, tuple(found)) for subject, found in panels),
    )


TABLES = ("confusion", "gate_costs", "funnel", "session_order")
"""Those that a figure shows; the one of all trials is as long as the run."""


def drawings_of(data: Drawable) -> tuple[list[Drawing], list[NotDrawn]]:
    """Return the figures that have data, in the order of the report, and the others."""
    everything: tuple[Drawing | NotDrawn, ...] = (
        success(data.groups, data.word),
        scatter(data.groups, data.word),
        tasks(data.groups, data.word),
        gains(data.gains, data.word),
        confusion(data.tables, data.word),
        costs(data.tables),
        reliability(data.bins),
        funnel(data.tables),
        session_order(data.tables),
        motions(data.motions),
        bands(data.bands),
        *(distributions(subject, panels) for subject, panels in data.distributions),
    )
    drawn = [item for item in everything if isinstance(item, Drawing)]
    return drawn, [item for item in everything if isinstance(item, NotDrawn)]


def _group_alone(group: RateGroup) -> RateGroup:
    recorded, sim = group.recorded_common, group.sim_common
    return replace(
        group,
        recorded=_alone(group.recorded),
        sim=_alone(group.sim),
        executed=None if group.executed is None else _alone(group.executed),
        episodes=(),
        recorded_common=None if recorded is None else _alone(recorded),
        sim_common=None if sim is None else _alone(sim),
    )


def _alone(measurement: Measurement) -> Measurement:
    return replace(measurement, episodes=())


def _curves(summaries: Iterable[MotionSummary]) -> dict[str, Sequence[Packed]]:
    """Gather curves by what was compared with what; planned comes before executed."""
    found: dict[str, list[Packed]] = {}
    for summary in summaries:
        name = f"{summary.side} to {summary.against}"
        found.setdefault(name, []).append(summary.curve_m)
    return {name: found[name] for name in sorted(found, key=lambda name: name not in FIRST)}


FIRST = ("recorded to planned", "recorded to executed")
