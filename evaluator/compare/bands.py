"""Imported runs of one motion: recorded runs against simulated runs, band against band.

Nothing pairs such runs and they share no clock, so they are compared over normalised time. A
simulated run says so by its ``derived`` record or by a tag ``simulated`` or ``engine:<name>``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.compare.measure import measured, slug
from evaluator.compare.replays import DerivedFile
from evaluator.compare.trial import tcp_track
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import (
    MOVING_THRESHOLD_M,
    BandDistance,
    Repeatability,
    band_distance,
    moving_part,
    repeatability,
)
from evaluator.result import Exclusion, Measurement, Table

NO_INTERVAL = "the runs' own spread is the repeatability beside it"

WHOLE = "whole recordings, waiting at their ends included"
MOVING = (
    "the moving part only, from leaving the start to arriving at the end, each within "
    f"{MOVING_THRESHOLD_M * 1000:.0f} mm"
)

DISTANCES: tuple[tuple[str, str], ...] = (
    (
        "mean_over_pairs_m",
        "distance over normalised time, mean over all (recorded, simulated) pairs of runs",
    ),
    ("between_mean_curves_m", "distance of the two mean curves, mean over normalised time"),
    ("max_between_mean_curves_m", "largest distance of the two mean curves"),
    ("end_point_over_pairs_m", "distance of the end points, mean over all pairs of runs"),
    ("end_point_between_means_m", "distance of the mean end points"),
)
SPREADS: tuple[tuple[str, str], ...] = (
    ("mean_m", "root mean square distance from the mean curve, mean over normalised time"),
    ("worst_m", "root mean square distance from the mean curve at its worst instant"),
    ("end_point_m", "root mean square distance from the mean end point"),
)


@dataclass(frozen=True, kw_only=True)
class BandReport:
    """What the imported runs say."""

    measurements: tuple[Measurement, ...] = ()
    tables: tuple[Table, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    missing: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Run:
    episode: str
    task: str
    engine: str | None
    """None for a recorded run."""
    track: PoseTrajectory


def compare_bands(recorded: Sequence[Episode], files: Sequence[DerivedFile]) -> BandReport:
    """Compare the end-effector bands of imported runs, per task and simulation engine."""
    imported = [(e, engine_of(e.info)) for e in recorded if e.info.kind == "imported"]
    imported += [
        (file.episode, file.derived.engine or "unnamed engine")
        for file in files
        if file.episode.info.kind == "imported"
        and file.derived.kind == "replay"
        and file.derived.plan_id is None
    ]
    runs, left_out = _runs(imported)
    if not runs:  # nothing imported, or imported without a robot, as an RGB-D folder
        return BandReport()
    measurements: list[Measurement] = []
    tables: list[Table] = []
    missing: list[str] = []
    for task in sorted({run.task for run in runs}):
        of_task = [run for run in runs if run.task == task]
        real = [run for run in of_task if run.engine is None]
        engines = sorted({run.engine for run in of_task if run.engine is not None})
        if not real or not engines:
            side = "recorded" if not real else "simulated"
            missing.append(f"bands of {task or 'the imported runs'}: no {side} run")
        measurements += _spread(task, "recorded", real) if real else []
        rows = []
        for engine in engines:
            simulated = [run for run in of_task if run.engine == engine]
            measurements += _spread(task, engine, simulated)
            if real:
                measurements += _distance(task, engine, real, simulated)
        by_id = {m.id: m for m in measurements}
        for engine in engines if real else ():
            rows.append(_row(task, engine, by_id))
        if rows:
            tables.append(_table(f"bands_{len(tables)}", task, rows))
    return BandReport(
        measurements=tuple(measurements),
        tables=tuple(tables),
        exclusions=tuple(left_out),
        missing=tuple(missing),
    )


def engine_of(info: EpisodeInfo) -> str | None:
    """Return the engine of a simulated run, None for a recorded one."""
    for tag in info.tags:
        if tag.startswith("engine:"):
            return tag.removeprefix("engine:") or "unnamed engine"
    return "unnamed engine" if "simulated" in info.tags else None


def _runs(imported: Sequence[tuple[Episode, str | None]]) -> tuple[list[_Run], list[Exclusion]]:
    runs, left_out = [], []
    for episode, engine in imported:
        track = tcp_track(episode)
        if track is None or len(track) < 2:
            reason = "no end-effector poses (a topic ending with /tcp/pose)"
            left_out.append(Exclusion(episode=episode.info.id, scope="bands", reason=reason))
            continue
        info = episode.info
        runs.append(_Run(episode=info.id, task=info.task, engine=engine, track=track))
    return runs, left_out


def _distance(
    task: str, engine: str, real: Sequence[_Run], simulated: Sequence[_Run]
) -> list[Measurement]:
    measurements = []
    for prefix, what, cut in (("", WHOLE, _whole), ("moving_", MOVING, moving_part)):
        distance = band_distance(
            [cut(run.track) for run in real], [cut(run.track) for run in simulated]
        )
        measurements += [
            measured(
                f"bands.{slug(task)}.{slug(engine)}.{prefix}{name}",
                partial(_field, distance, name),
                unit="m",
                definition=f"end effector, {len(real)} recorded against {len(simulated)} {engine} "
                f"runs, unpaired: {words}; {what}",
                n=len(real) * len(simulated),
                counted="pair of runs",
                reason_without_interval=NO_INTERVAL,
                episodes=[run.episode for run in (*real, *simulated)],
            )
            for name, words in DISTANCES
        ]
    return measurements


def _whole(track: PoseTrajectory) -> PoseTrajectory:
    return track


def _field(record: BandDistance | Repeatability, name: str) -> float:
    return float(getattr(record, name))


def _spread(task: str, side: str, runs: Sequence[_Run]) -> list[Measurement]:
    spread: Repeatability | None = None
    refusal: UndefinedStatisticError | None = None
    try:
        spread = repeatability([run.track for run in runs])
    except UndefinedStatisticError as error:
        refusal = error

    def read(name: str) -> float:
        if spread is None:
            raise refusal or UndefinedStatisticError(statistic="repeatability", reason="no run")
        return _field(spread, name)

    return [
        measured(
            f"repeatability.{slug(task)}.{slug(side)}.{name}",
            partial(read, name),
            unit="m",
            definition=f"end effector, spread of {len(runs)} {side} runs: {words}",
            n=len(runs),
            counted="run",
            reason_without_interval="not estimated",
            episodes=[run.episode for run in runs],
        )
        for name, words in SPREADS
    ]


def _row(
    task: str, engine: str, by_id: dict[str, Measurement]
) -> tuple[str | int | float | None, ...]:
    def millimetres(measurement_id: str) -> float | None:
        value = by_id[measurement_id].value
        return None if value is None else round(1000 * value, 2)

    band = f"bands.{slug(task)}.{slug(engine)}"
    return (
        engine,
        by_id[f"repeatability.{slug(task)}.recorded.mean_m"].n,
        by_id[f"repeatability.{slug(task)}.{slug(engine)}.mean_m"].n,
        millimetres(f"{band}.mean_over_pairs_m"),
        millimetres(f"{band}.moving_mean_over_pairs_m"),
        millimetres(f"{band}.moving_between_mean_curves_m"),
        millimetres(f"{band}.end_point_over_pairs_m"),
        millimetres(f"repeatability.{slug(task)}.recorded.mean_m"),
        millimetres(f"repeatability.{slug(task)}.{slug(engine)}.mean_m"),
    )


def _table(table_id: str, task: str, rows: Sequence[tuple[str | int | float | None, ...]]) -> Table:
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
            "end-point error (mm)",
            "recorded repeatability (mm)",
            "simulated repeatability (mm)",
        ),
        rows=tuple(rows),
        note="Unpaired runs without a common clock: end-effector positions, uniform samples over "
        "time. The first error compares whole recordings and so counts different waiting times "
        f"as error; the second cuts waiting ({MOVING}). Errors are means over all pairs of runs "
        "unless they say mean curves. Repeatability: RMS distance from the side's own mean curve.",
    )
