"""Recorded against simulated runs as tables."""

from collections.abc import Mapping, Sequence

from evaluator.compare.band_measurements import BAND_WIDTH, MOVING, BandCurve
from evaluator.compare.in_tables import degrees, millimetres
from evaluator.compare.measure import slug
from evaluator.result import Cell, Measurement, Table

OVER_TIME = range(0, 101, 10)
"""Places on the curves that the table shows, in percent of the motion."""


def band_row(task: str, engine: str, by_id: Mapping[str, Measurement]) -> tuple[Cell, ...]:
    """One engine's row."""

    def length(measurement_id: str) -> float | None:
        return millimetres(by_id[measurement_id].value)

    band = f"bands.{slug(task)}.{slug(engine)}"
    recorded, simulated = (f"repeatability.{slug(task)}.{slug(s)}" for s in ("recorded", engine))
    inside = by_id[f"{band}.moving_inside_band"].value
    return (
        engine,
        by_id[f"{recorded}.mean_m"].n,
        by_id[f"{simulated}.mean_m"].n,
        length(f"{band}.mean_over_pairs_m"),
        length(f"{band}.moving_mean_over_pairs_m"),
        length(f"{band}.moving_between_mean_curves_m"),
        length(f"{band}.moving_without_offset_m"),
        length(f"{band}.moving_along_path_m"),
        length(f"{band}.end_point_over_pairs_m"),
        degrees(by_id[f"{band}.moving_turned_over_pairs_rad"].value),
        length(f"{recorded}.mean_m"),
        length(f"{simulated}.mean_m"),
        None if inside is None else f"{100 * inside:.0f} %",
    )


def band_table(table_id: str, task: str, rows: Sequence[tuple[Cell, ...]]) -> Table:
    """One task's table."""
    return Table(
        id=table_id,
        title=f"Recorded against simulated runs: {task}" if task else "Imported runs",
        columns=(
            "engine",
            "recorded runs",
            "simulated runs",
            "error over normalised time (mm)",
            "the same, moving part (mm)",
            "moving part, mean curves (mm)",
            "the same without offset (mm)",
            "moving part, along the path (mm)",
            "end-point error (mm)",
            "moving part, turned (deg)",
            "recorded repeatability (mm)",
            "simulated repeatability (mm)",
            "inside the recorded band",
        ),
        rows=tuple(rows),
        note="Unpaired runs without a common clock: uniform samples over time. The first error "
        "compares whole recordings and so counts different waiting times as error; the second cuts "
        f"waiting ({MOVING}). Errors are means over all pairs of runs unless they say mean curves. "
        "Without offset: one mean curve laid over the other by a rigid motion. Along the path: at "
        "equal shares of the way, whatever the speed. Turned: since the start. Repeatability: RMS "
        f"distance from the side's mean curve; the band reaches {BAND_WIDTH:g} of the recorded.",
    )


def profile_table(curves: Sequence[BandCurve]) -> tuple[Table, ...]:
    """Distances and spreads at eleven places of the moving part."""
    rows = [
        (
            curve.task,
            curve.engine,
            place,
            millimetres(curve.distance_m[place]),
            millimetres(curve.recorded_spread_m[place] if curve.recorded_spread_m else None),
            millimetres(curve.simulated_spread_m[place] if curve.simulated_spread_m else None),
        )
        for curve in curves
        if curve.part == "moving"
        for place in OVER_TIME
    ]
    if not rows:
        return ()
    return (
        Table(
            id="bands_over_time",
            title="Bands over time, moving part",
            columns=(
                "task",
                "engine",
                "time (%)",
                "between mean curves (mm)",
                "recorded repeatability (mm)",
                "simulated repeatability (mm)",
            ),
            rows=tuple(rows),
            note="From leaving the start to arriving at the end.",
        ),
    )
