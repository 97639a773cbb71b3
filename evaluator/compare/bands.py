"""Imported runs of one motion: recorded runs against simulated runs, band against band.

Nothing pairs such runs and they share no clock, so they are compared over normalised time. A
simulated run says so by its ``derived`` record or by a tag ``simulated`` or ``engine:<name>``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import object_pose_topics, pose_track
from evaluator.compare.band_measurements import (
    BandCurve as BandCurve,  # part of what the report says
)
from evaluator.compare.band_measurements import (
    BandPath,
    Run,
    Side,
    band_paths,
    distance_measurements,
    inside_band,
    spread_measurements,
)
from evaluator.compare.end_points import compare_end_points
from evaluator.compare.measure import Part, degrees, millimetres
from evaluator.compare.trial import tcp_track
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import Quantity
from evaluator.metrics.trajectory import band_distance, moving_part, repeatability
from evaluator.motion_measurements import (
    BAND_ALONG_PATH,
    BAND_DISTANCES,
    BAND_WIDTH,
    BAND_WITHOUT_OFFSET,
    INSIDE_BAND,
    MOVING,
    REPEATABILITY,
)
from evaluator.result import Cell, Exclusion, Measurement, Table
from evaluator.run_reader.episodes import DerivedFile

FITTED_TO = "fitted_to"
"""Setting of a replay: ids of the recorded runs from which something was identified."""
OVER_TIME = range(0, 101, 10)
"""Places on the curves that the table shows, in percent of the motion."""


def band_row(task: str, engine: str, by_id: Mapping[str, Measurement]) -> dict[str, Cell]:
    """One engine's row.

    Args:
        task: Task of the runs.
        engine: The simulated side.
        by_id: Measurements of that task, by their ids.
    """

    def of(quantity: Quantity, side: str = "") -> Measurement:
        words = {"task": task, "engine": engine, "side": side, "what": "", "count": 0}
        return by_id[quantity.of(**words).id]

    recorded, simulated = (of(REPEATABILITY["mean_m"], side) for side in ("recorded", engine))
    whole, moving = BAND_DISTANCES[""], BAND_DISTANCES["moving_"]
    mean = "mean_over_pairs_m"
    return {
        "engine": engine,
        "recorded runs": recorded.n,
        "simulated runs": simulated.n,
        "error over normalised time (mm)": millimetres(of(whole[mean]).value),
        "the same, moving part (mm)": millimetres(of(moving[mean]).value),
        "moving part, mean curves (mm)": millimetres(of(moving["between_mean_curves_m"]).value),
        "the same without offset (mm)": millimetres(of(BAND_WITHOUT_OFFSET).value),
        "moving part, along the path (mm)": millimetres(of(BAND_ALONG_PATH).value),
        "end-point error (mm)": millimetres(of(whole["end_point_over_pairs_m"]).value),
        "moving part, turned (deg)": degrees(of(moving["turned_over_pairs_rad"]).value),
        "recorded repeatability (mm)": millimetres(recorded.value),
        "simulated repeatability (mm)": millimetres(simulated.value),
        "inside the recorded band": of(INSIDE_BAND).value,
    }


def band_table(table_id: str, task: str, rows: Sequence[Mapping[str, Cell]]) -> Table:
    """One task's table.

    Args:
        table_id: Id of the table, its file name too.
        task: Task of the runs; may be empty.
        rows: One for each engine, as ``band_row`` lays it out.
    """
    return Table.of(
        rows,
        id=table_id,
        title=f"Recorded against simulated runs: {task}" if task else "Imported runs",
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
        {
            "task": curve.task,
            "engine": curve.engine,
            "time (%)": place,
            "between mean curves (mm)": millimetres(curve.distance_m[place]),
            "recorded repeatability (mm)": _at(curve.recorded_spread_m, place),
            "simulated repeatability (mm)": _at(curve.simulated_spread_m, place),
        }
        for curve in curves
        if curve.part == "moving"
        for place in OVER_TIME
    ]
    if not rows:
        return ()
    table = Table.of(
        rows,
        id="bands_over_time",
        title="Bands over time, moving part",
        note="From leaving the start to arriving at the end.",
    )
    return (table,)


def _at(spread_m: Sequence[float] | None, place: int) -> float | None:
    return millimetres(spread_m[place]) if spread_m else None


@dataclass(frozen=True, kw_only=True)
class BandReport(Part):
    """What the imported runs say."""

    curves: tuple[BandCurve, ...] = ()
    paths: tuple[BandPath, ...] = ()
    """Where tool and objects went, for drawing."""


def compare_bands(recorded: Sequence[Episode], files: Sequence[DerivedFile]) -> BandReport:
    """Compare the end-effector bands of imported runs, per task and simulation engine.

    Args:
        recorded: Recorded episodes; only imported ones are looked at.
        files: Derived episodes; only imported replays without a plan are looked at.
    """
    runs, left_out = _runs(recorded, files)
    if not runs:  # nothing imported, or imported without a robot, as an RGB-D folder
        return BandReport()
    measurements: list[Measurement] = []
    tables: list[Table] = []
    more: list[Table] = []
    curves: list[BandCurve] = []
    missing: list[str] = []
    paths: list[BandPath] = []
    for task in sorted({run.task for run in runs}):
        real, simulated = _sides(task, runs)
        if not real.runs or not simulated:
            lacking = "simulated" if real.runs else "recorded"
            missing.append(f"bands of {task or 'the imported runs'}: no {lacking} run")
        sides = ([real] if real.runs else []) + simulated
        paths += band_paths(task, sides)
        found = [m for side in sides for m in spread_measurements(task, side)]
        for side in simulated if real.runs else ():
            found += distance_measurements(task, real, side)
            found += inside_band(task, real, side)
            curves += [_curve(task, real, side, part) for part in ("whole", "moving")]
        by_id = {m.id: m for m in found}
        measurements += found
        if real.runs and simulated:
            rows = [band_row(task, side.name, by_id) for side in simulated]
            number = len(tables)
            tables.append(band_table(f"bands_{number}", task, rows))
            bodies = compare_end_points(task, real, simulated, f"bands_end_points_{number}")
            measurements += bodies.measurements
            more += bodies.tables
            left_out += bodies.exclusions
    return BandReport(
        measurements=tuple(measurements),
        tables=(*tables, *more, *profile_table(curves)),
        exclusions=tuple(left_out),
        missing=tuple(missing),
        curves=tuple(curves),
        paths=tuple(paths),
    )


def engine_of(info: EpisodeInfo) -> str | None:
    """Return the engine of a simulated run, None for a recorded one."""
    for tag in info.tags:
        if tag.startswith("engine:"):
            return tag.removeprefix("engine:") or "unnamed engine"
    return "unnamed engine" if "simulated" in info.tags else None


def _runs(
    recorded: Sequence[Episode], files: Sequence[DerivedFile]
) -> tuple[list[Run], list[Exclusion]]:
    runs, left_out = [], []
    found: list[tuple[Episode, str | None, Derived | None]] = [
        (e, engine_of(e.info), None) for e in recorded if e.info.kind == "imported"
    ]
    found += [(file.episode, _side_name(file.derived), file.derived) for file in _newest(files)]
    for episode, engine, derived in found:
        track = tcp_track(episode)
        if track is None or len(track) < 2:
            reason = "no end-effector poses (a topic ending with /tcp/pose)"
            left_out.append(Exclusion(episode=episode.info.id, scope="bands", reason=reason))
            continue
        info = episode.info
        objects = {
            name: pose_track(episode, topic) for name, topic in object_pose_topics(episode).items()
        }
        runs.append(
            Run(
                episode=episode.path.stem if derived and derived.source_episode else info.id,
                task=info.task,
                engine=engine,
                track=track,
                objects={name: each for name, each in objects.items() if len(each) > 1},
                replayed_from=None if derived is None else derived.source_episode or None,
                fitted_to=frozenset() if derived is None else _fitted_to(derived),
            )
        )
    return runs, left_out


def _fitted_to(derived: Derived) -> frozenset[str]:
    """Recorded runs from which something was identified that a replay uses."""
    named = derived.settings.get(FITTED_TO, ())
    return (
        frozenset(str(name) for name in named) if isinstance(named, list | tuple) else frozenset()
    )


def _newest(files: Sequence[DerivedFile]) -> list[DerivedFile]:
    """Imported replays without a plan; of several of one run by the same name the newest."""
    newest: dict[tuple[str, str], DerivedFile] = {}
    for file in sorted(files, key=lambda file: file.path.stat().st_mtime_ns):
        derived = file.derived
        if file.info.kind == "imported" and derived.kind == "replay" and derived.plan_id is None:
            source = derived.source_episode or file.name
            newest[_side_name(derived), source] = file
    return sorted(newest.values(), key=lambda file: file.name)


def _side_name(derived: Derived) -> str:
    """Name an engine; a replay of a recorded run says which trajectory it followed, too."""
    engine = derived.engine or "unnamed engine"
    if not derived.source_episode:
        return engine
    words = [engine, derived.trajectory or "", "calibrated" if derived.calibration_id else ""]
    return " ".join(word for word in words if word)


def _sides(task: str, runs: Sequence[Run]) -> tuple[Side, list[Side]]:
    """The recorded runs of a task, and the simulated ones by engine."""
    of_task = [run for run in runs if run.task == task]
    engines = sorted({run.engine for run in of_task if run.engine is not None})
    real = Side(name="recorded", runs=tuple(run for run in of_task if run.engine is None))
    return real, [
        Side(name=engine, runs=tuple(run for run in of_task if run.engine == engine))
        for engine in engines
    ]


def _curve(task: str, real: Side, simulated: Side, part: str) -> BandCurve:
    tracks = [
        [moving_part(run.track) if part == "moving" else run.track for run in side.runs]
        for side in (real, simulated)
    ]
    spreads: list[tuple[float, ...]] = []
    for side in tracks:
        try:
            spreads.append(tuple(repeatability(side).profile_m.tolist()))
        except UndefinedStatisticError:
            spreads.append(())
    return BandCurve(
        task=task,
        engine=simulated.name,
        part=part,
        num_recorded=len(real.runs),
        num_simulated=len(simulated.runs),
        distance_m=tuple(band_distance(tracks[0], tracks[1]).profile_m.tolist()),
        recorded_spread_m=spreads[0],
        simulated_spread_m=spreads[1],
    )
