"""Imported runs of one motion: where bodies go in recorded runs and in simulated ones.

A simulated run says so by its ``derived`` record or by a tag ``simulated`` or ``engine:<name>``.
"""

from collections.abc import Sequence

from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import object_pose_topics, pose_track
from evaluator.compare.end_points import Run, Side, compare_end_points
from evaluator.compare.measure import Part
from evaluator.compare.trial import tcp_track
from evaluator.result import Exclusion, Measurement, Table
from evaluator.run_reader.episodes import DerivedFile

FITTED_TO = "fitted_to"
"""Setting of a replay: ids of the recorded runs from which something was identified."""


def compare_imported(recorded: Sequence[Episode], files: Sequence[DerivedFile]) -> Part:
    """Compare where tool and objects of imported runs end, per task and simulation engine.

    Args:
        recorded: Recorded episodes; only imported ones are looked at.
        files: Derived episodes; only imported replays without a plan are looked at.
    """
    runs, left_out = _runs(recorded, files)
    if not runs:  # nothing imported, or imported without a robot, as an RGB-D folder
        return Part()
    measurements: list[Measurement] = []
    tables: list[Table] = []
    missing: list[str] = []
    for task in sorted({run.task for run in runs}):
        real, simulated = _sides(task, runs)
        if not real.runs or not simulated:
            lacking = "simulated" if real.runs else "recorded"
            missing.append(f"motions of {task or 'the imported runs'}: no {lacking} run")
            continue
        name = f"end_points_{sum(table.id.startswith('end_points') for table in tables)}"
        bodies = compare_end_points(task, real, simulated, name)
        measurements += bodies.measurements
        tables += bodies.tables
        left_out += bodies.exclusions
    return Part(
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
            left_out.append(Exclusion(episode=episode.info.id, scope="motions", reason=reason))
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
