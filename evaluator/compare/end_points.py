"""Where bodies of imported runs go, the tool and the objects it moves: recorded against simulated.

A simulated run that was replayed from one recorded run is compared with that run alone; one that
belongs to no single recorded run is compared with each of them. It says that it is simulated by its
``derived`` record or by a tag ``simulated`` or ``engine:<name>``.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import object_pose_topics, pose_track
from bridge.episode.topics import TCP_POSE
from bridge.errors import BridgeError
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.compare.measure import Part, ends, joined, measured_median, millimetres, milliseconds
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import find_lag_s, position_errors
from evaluator.motion_measurements import BODY_DISTANCES
from evaluator.result import Cell, Exclusion, Measurement, Table
from evaluator.run_reader.episodes import FITTED_TO, DerivedFile

TOOL_BODY = "tool"
MOVED_M = 0.01
"""A body has left its start, and counts as moved, beyond this."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One imported run."""

    episode: str
    task: str
    engine: str | None
    """None for a recorded run."""
    bodies: Mapping[str, PoseTrajectory] = field(default_factory=dict)
    """Motions of the tool and of the objects."""
    replayed_from: str | None = None
    """The recorded run that a replay was made from; None where it belongs to no single one."""
    fitted_to: frozenset[str] = frozenset()
    """Recorded runs from which something was identified that a replay uses."""


def body_distance(recorded: PoseTrajectory, simulated: PoseTrajectory) -> dict[str, float]:
    """Say how far a simulated body is from the recorded one, by the name in ``BODY_DISTANCES``.

    Clocks of their own are laid over each other where the body leaves its start; then the lag of
    least distance is taken out, as for replays. The displacement is the end minus the start, so
    where both began plays no part in it.
    """
    ends_m = recorded.p_m[-1] - simulated.p_m[-1]
    starts_m = recorded.p_m[0] - simulated.p_m[0]
    laid = simulated.shifted(_leaves_ns(recorded) - _leaves_ns(simulated))
    try:
        lag_s = find_lag_s(recorded.stamps_ns, recorded.p_m, laid)
        later = laid.shifted(round(lag_s * NS_PER_S))
        path_m = float(position_errors(recorded.stamps_ns, recorded.p_m, later).mean())
    except UndefinedStatisticError:
        lag_s = path_m = float("nan")  # which leaves the mean undefined, with its reason
    return {
        "end_point_m": float(np.linalg.norm(ends_m)),
        "displacement_m": float(np.linalg.norm(ends_m - starts_m)),
        "path_mean_m": path_m,
        "lag_s": lag_s,
    }


def _leaves_ns(track: PoseTrajectory) -> int:
    """When a body leaves its start; of one that stays, its first instant."""
    away = np.linalg.norm(track.p_m - track.p_m[0], axis=1) > MOVED_M
    return int(track.stamps_ns[int(np.argmax(away))])


def moved_bodies(real: Sequence[Run]) -> list[str]:
    """List the tool and the objects that recorded runs move: by 10 mm, in the median over runs."""
    found = [TOOL_BODY]
    for name in sorted({name for run in real for name in run.bodies} - {TOOL_BODY}):
        tracks = [run.bodies[name] for run in real if name in run.bodies]
        if median(float(np.linalg.norm(t.p_m[-1] - t.p_m[0])) for t in tracks) > MOVED_M:
            found.append(name)
    return found


def _compared(
    real: Sequence[Run], simulated: Sequence[Run], body: str
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Compare one body with those recorded runs that have a counterpart.

    Found are distances by run and name in ``BODY_DISTANCES``, over several simulated runs the mean;
    and runs to which something was fitted, which say nothing about others.
    """
    found: dict[str, dict[str, float]] = {}
    fitted = []
    for run in real:
        others = [o for o in simulated if o.replayed_from in (None, run.episode)]
        others = [other for other in others if body in other.bodies and body in run.bodies]
        if others:
            each = [body_distance(run.bodies[body], other.bodies[body]) for other in others]
            found[run.episode] = {
                name: float(np.mean([item[name] for item in each])) for name in BODY_DISTANCES
            }
            fitted += [run.episode] * any(run.episode in other.fitted_to for other in others)
    return found, fitted


def compare_end_points(
    task: str, real: Sequence[Run], engines: Mapping[str, Sequence[Run]], table_id: str
) -> Part:
    """Compare every moved body of a task with every engine: medians over recorded runs."""
    measurements: list[Measurement] = []
    rows: list[dict[str, Cell]] = []
    left_out: dict[Exclusion, None] = {}
    for body in moved_bodies(real):
        for engine, simulated in engines.items():
            found, fitted = _compared(real, simulated, body)
            if not found:
                continue
            counted = [episode for episode in found if episode not in fitted]
            by_name: dict[str, Measurement] = {}
            for name, quantity in BODY_DISTANCES.items():
                values = [found[episode][name] for episode in counted]
                words = f"{body}, {len(counted)} recorded runs against {engine}"
                by_name[name] = measured_median(
                    quantity.of(task=task, engine=engine, body=body, what=words),
                    values,
                    reason_if_undefined="no recorded run is left to compare with",
                    n=len(values),
                    counted="run",
                    episodes=counted,
                )
            measurements += by_name.values()
            low, high = (millimetres(end) for end in ends(by_name["end_point_m"].interval))
            rows.append(
                {
                    "body": body,
                    "engine": engine,
                    "recorded runs": len(counted),
                    "fitted to": len(fitted),
                    "end-point error (mm)": millimetres(by_name["end_point_m"].value),
                    "low (mm)": low,
                    "high (mm)": high,
                    "displacement error (mm)": millimetres(by_name["displacement_m"].value),
                    "path (mm)": millimetres(by_name["path_mean_m"].value),
                    "lag (ms)": milliseconds(by_name["lag_s"].value),
                }
            )
            why = f"the replays of {engine} were fitted to this run; only held-out runs count"
            for episode in fitted if body != TOOL_BODY else ():
                left_out[Exclusion(episode=episode, scope="end points", reason=why)] = None
    if not rows:
        return Part()
    error = "end-point error (mm)"
    rows.sort(key=lambda row: (str(row["body"]), row[error] is None, float(row[error] or 0)))
    told = {row["body"]: row for row in reversed(rows) if row[error] is not None}
    nearest = [f"{each['body']}: {each['engine']}, {each[error]} mm" for each in told.values()]
    table = Table.of(
        rows,
        id=table_id,
        title=f"End points: {task}",
        note=f"Nearest to the recorded end: {'; '.join(reversed(nearest)) or 'none'}. Medians over "
        "recorded runs. A replay is compared with the run that it was made from, other simulated "
        "runs with every recorded one (mean over them). Displacement: end minus start, so where a "
        "body began plays no part. Path: mean distance after both clocks are begun where the "
        "body leaves its start and the remaining lag is taken out. "
        "Intervals of the end point: order statistics, 95 %. Runs that something was fitted to do "
        "not count.",
    )
    return Part(measurements=tuple(measurements), tables=(table,), exclusions=tuple(left_out))


def compare_imported(recorded: Sequence[Episode], files: Sequence[DerivedFile]) -> Part:
    """Compare where tool and objects of imported runs end, per task and simulation engine."""
    runs, left_out = _runs(recorded, files)
    if not runs:  # nothing imported, or imported without a robot, as an RGB-D folder
        return Part()
    parts = [Part(exclusions=tuple(left_out))]
    for task in sorted({run.task for run in runs}):
        of_task = [run for run in runs if run.task == task]
        real = [run for run in of_task if run.engine is None]
        names = sorted({run.engine for run in of_task if run.engine is not None})
        simulated = {name: [run for run in of_task if run.engine == name] for name in names}
        if real and simulated:
            name = f"end_points_{sum(bool(part.tables) for part in parts)}"
            parts.append(compare_end_points(task, real, simulated, name))
        else:
            lacking = "simulated" if real else "recorded"
            missing = f"motions of {task or 'the imported runs'}: no {lacking} run"
            parts.append(Part(missing=(missing,)))
    return joined(parts)


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
        track = None
        topics = [t for t in episode.topics_of_type(schema.POSE_STAMPED) if t.endswith(TCP_POSE)]
        with suppress(BridgeError):
            track = pose_track(episode, topics[0]) if topics else None
        if track is None or len(track) < 2:
            reason = "no end-effector poses (a topic ending with /tcp/pose)"
            left_out.append(Exclusion(episode=episode.info.id, scope="motions", reason=reason))
            continue
        info, topics_of = episode.info, object_pose_topics(episode)
        objects = {name: pose_track(episode, topic) for name, topic in topics_of.items()}
        moving = {name: each for name, each in objects.items() if len(each) > 1}
        named = () if derived is None else derived.settings.get(FITTED_TO)
        runs.append(
            Run(
                episode=episode.path.stem if derived and derived.source_episode else info.id,
                task=info.task,
                engine=engine,
                bodies={TOOL_BODY: track} | moving,
                replayed_from=None if derived is None else derived.source_episode or None,
                fitted_to=frozenset(map(str, named if isinstance(named, list | tuple) else ())),
            )
        )
    return runs, left_out


def _newest(files: Sequence[DerivedFile]) -> list[DerivedFile]:
    """Imported replays without a plan; of several of one run by the same name the newest."""
    newest: dict[tuple[str, str], DerivedFile] = {}
    for file in sorted(files, key=lambda file: file.path.stat().st_mtime_ns):
        derived = file.derived
        if file.info.kind == "imported" and derived.kind == "replay" and derived.plan_id is None:
            newest[_side_name(derived), derived.source_episode or file.name] = file
    return sorted(newest.values(), key=lambda file: file.name)


def _side_name(derived: Derived) -> str:
    """Name an engine; a replay of a recorded run says which trajectory it followed, too."""
    words = [derived.engine or "unnamed engine"]
    if derived.source_episode:
        words += [derived.trajectory or "", "calibrated" if derived.calibration_id else ""]
    return " ".join(filter(None, words))
