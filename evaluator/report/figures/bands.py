"""Simulated runs against the band of recorded ones, over normalised time."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from evaluator.compare.band_measurements import BAND_WIDTH, BandCurve
from evaluator.report.figures.drawing import (
    LEGEND_LINE_IN,
    LIGHT,
    Drawing,
    NotDrawn,
    grid,
    legend,
    listed,
    panel,
)
from evaluator.report.figures.spreads import LINES
from evaluator.result import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("sim", "third", "fourth", "ink", "soft")
"""The recorded colour is the band's."""
PLACES = range(0, 101, 5)
"""Instants the table beside the figure shows."""


def bands(curves: Sequence[BandCurve]) -> Drawing | NotDrawn:
    """Draw how far simulated mean curves lie from recorded ones, and how far these reach."""
    moving = [curve for curve in curves if curve.part == "moving"][: len(COLOURS)]
    if not moving:
        reason = "no imported motion has both recorded and simulated runs"
        return NotDrawn(id="bands", reason=reason)
    spreads = {curve.task: curve.recorded_spread_m for curve in moving if curve.recorded_spread_m}
    head = 0.12 + LEGEND_LINE_IN * (len(moving) + len(spreads))

    def draw(figure: "Figure") -> None:
        axes = panel(figure, left=0.5, bottom=0.4, top=head)
        grid(axes)
        for task, spread in spreads.items():
            reach = [1000 * BAND_WIDTH * value for value in spread]
            label = f"{task}: {BAND_WIDTH:g} repeatabilities of the recorded runs"
            axes.fill_between(
                range(len(reach)),
                0,
                reach,
                color=LIGHT["rec"],
                alpha=0.18,
                linewidth=0,
                label=label,
            )
        for index, curve in enumerate(moving):
            axes.plot(
                range(len(curve.distance_m)),
                [1000 * value for value in curve.distance_m],
                color=LIGHT[COLOURS[index]],
                linestyle=LINES[index],
                linewidth=1.5,
                label=_named(curve),
            )
        axes.set_xlim(0, 100)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("time from start to end (%)")
        axes.set_ylabel("between mean curves (mm)")
        legend(axes, columns=1)

    return Drawing(
        id="bands",
        title="Simulated runs against the recorded band",
        caption="Distance of the simulated mean curve from the recorded one over the moving part, "
        "in normalised time. Shaded: as far as the recorded runs reach themselves, "
        f"{BAND_WIDTH:g} root mean square distances from their mean.",
        alt="Distance of mean curves: "
        + listed(
            [
                f"{_named(curve)}: up to {1000 * max(curve.distance_m):.0f} mm, "
                f"{1000 * curve.distance_m[-1]:.1f} mm at the end"
                for curve in moving
            ]
        ),
        table=Table(
            id="figure_bands",
            title="",
            columns=("runs", "time (%)", "distance (mm)", "recorded repeatability (mm)"),
            rows=tuple(
                (
                    _named(curve),
                    place,
                    round(1000 * curve.distance_m[place], 2),
                    round(1000 * curve.recorded_spread_m[place], 2)
                    if curve.recorded_spread_m
                    else None,
                )
                for curve in moving
                for place in PLACES
            ),
        ),
        height_in=2.35 + head,
        draw=draw,
    )


def _named(curve: BandCurve) -> str:
    return (
        f"{curve.task}, {curve.engine} ({curve.num_simulated} runs against "
        f"{curve.num_recorded} recorded)"
    )
