"""Where bodies of imported runs end, the tool and the objects it moves: recorded against simulated.

A simulated run that was replayed from one recorded run is compared with that run alone; one that
belongs to no single recorded run is compared with each of them. It says that it is simulated by its
``derived`` record or by a tag ``simulated`` or ``engine:<name>``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from statistics import median

import numpy as np
from jaxtyping import Float

from bridge.episode import schema
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import object_pose_topics, pose_track
from bridge.episode.topics import TCP_POSE
from bridge.errors import BridgeError
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.compare.measure import Part, ends, interval_or_reason, measured, millimetres
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import Defined
from evaluator.metrics.trajectory import MOVING_THRESHOLD_M, NORMALISED_SAMPLES, moving_part
from evaluator.motion_measurements import BODY_DISTANCES
from evaluator.result import Cell, Exclusion, Interval, Measurement, Table
from evaluator.run_reader.episodes import DerivedFile
from evaluator.statistics.intervals import median_interval

TOOL_BODY = "tool"


@dataclass(frozen=True, kw_only=True)
class Run:
    """One imported run."""

    episode: str
    task: str
    engine: str | None
    """None for a recorded run."""
    track: PoseTrajectory
    """Of the tool."""
    objects: Mapping[str, PoseTrajectory] = field(default_factory=dict)
    replayed_from: str | None = None
    """The recorded run that a replay was made from; None where it belongs to no single one."""
    fitted_to: frozenset[str] = frozenset()
    """Recorded runs from which something was identified that a replay uses."""

    def body(self, name: str) -> PoseTrajectory | None:
        """Return the motion of the tool or of an object; None where it was not recorded."""
        return self.track if name == TOOL_BODY else self.objects.get(name)


@dataclass(frozen=True, kw_only=True)
class Side:
    """Runs of one task that are compared together."""

    name: str
    """``recorded``, or the engine."""
    runs: tuple[Run, ...]


@dataclass(frozen=True, kw_only=True)
class BodyDistance:
    """How far a simulated body is from the recorded one; over several simulated runs the mean."""

    end_point_m: float
    displacement_m: float
    """Difference of end minus start: where both began plays no part."""
    over_time_m: float
    """Mean over normalised time."""
    moving_over_time_m: float


@dataclass(frozen=True, kw_only=True)
class BodyComparison:
    """One recorded run against the simulated runs it is compared with."""

    recorded: str
    simulated: tuple[str, ...]
    distance: BodyDistance
    fitted: bool
    """Something was fitted to this very run, so it says nothing about other runs."""


class _Course:
    """What of a track enters a distance; resampled once, however often it is compared."""

    def __init__(self, track: PoseTrajectory) -> None:
        self._track = track

    @property
    def end_m(self) -> Float[np.ndarray, "3"]:
        return np.asarray(self._track.p_m[-1])

    @property
    def way_m(self) -> Float[np.ndarray, "3"]:
        return np.asarray(self._track.p_m[-1] - self._track.p_m[0])

    @cached_property
    def whole_m(self) -> Float[np.ndarray, "num_samples 3"]:
        return np.asarray(self._track.normalised_time(NORMALISED_SAMPLES).p_m)

    @cached_property
    def moving_m(self) -> Float[np.ndarray, "num_samples 3"]:
        return np.asarray(moving_part(self._track).normalised_time(NORMALISED_SAMPLES).p_m)

    def distance(self, other: "_Course") -> BodyDistance:
        def between(a: np.ndarray, b: np.ndarray) -> float:
            return float(np.linalg.norm(a - b, axis=-1).mean())

        return BodyDistance(
            end_point_m=between(self.end_m, other.end_m),
            displacement_m=between(self.way_m, other.way_m),
            over_time_m=between(self.whole_m, other.whole_m),
            moving_over_time_m=between(self.moving_m, other.moving_m),
        )


def moved_bodies(real: Side) -> list[str]:
    """List the tool and the objects that recorded runs move: by 10 mm, in the median over runs."""
    found = [TOOL_BODY]
    for name in sorted({name for run in real.runs for name in run.objects}):
        ways = [
            float(np.linalg.norm(run.objects[name].p_m[-1] - run.objects[name].p_m[0]))
            for run in real.runs
            if name in run.objects
        ]
        if median(ways) > MOVING_THRESHOLD_M:
            found.append(name)
    return found


def compare_bodies(real: Side, simulated: Side, body: str) -> list[BodyComparison]:
    """Compare one body run by run; recorded runs without a counterpart are left out."""
    courses = {run.episode: _Course(track) for run in simulated.runs if (track := run.body(body))}
    found = []
    for run in real.runs:
        mine = run.body(body)
        others = [
            other
            for other in simulated.runs
            if other.replayed_from in (None, run.episode) and other.episode in courses
        ]
        if mine is None or not others:
            continue
        course = _Course(mine)
        each = [course.distance(courses[other.episode]) for other in others]
        found.append(
            BodyComparison(
                recorded=run.episode,
                simulated=tuple(other.episode for other in others),
                distance=BodyDistance(
                    **{
                        part.name: float(np.mean([getattr(item, part.name) for item in each]))
                        for part in fields(BodyDistance)
                    }
                ),
                fitted=any(run.episode in other.fitted_to for other in others),
            )
        )
    return found


def body_measurements(
    task: str, engine: str, body: str, compared: Sequence[BodyComparison]
) -> list[Measurement]:
    """Measure the medians over recorded runs; runs that something was fitted to do not count."""
    counted = [item for item in compared if not item.fitted]
    words = f"{body}, {len(counted)} recorded runs against {engine}"
    episodes = [name for item in counted for name in (item.recorded, *item.simulated)]
    return [
        _median_of(
            quantity.of(task=task, engine=engine, body=body, what=words),
            [getattr(item.distance, name) for item in counted],
            list(dict.fromkeys(episodes)),
        )
        for name, quantity in BODY_DISTANCES.items()
    ]


def _median_of(defined: Defined, values_m: list[float], episodes: list[str]) -> Measurement:
    interval, why_none = interval_or_reason(median_interval, values_m)

    def compute() -> tuple[float, Interval | None]:
        if not values_m:
            raise UndefinedStatisticError(
                statistic="median", reason="no recorded run is left to compare with"
            )
        return float(median(values_m)), interval

    return measured(
        defined,
        compute,
        n=len(values_m),
        counted="run",
        reason_without_interval=why_none,
        episodes=episodes,
    )


def compare_end_points(task: str, real: Side, sides: Sequence[Side], table_id: str) -> Part:
    """Compare every moved body of a task with every engine."""
    measurements: list[Measurement] = []
    rows: list[dict[str, Cell]] = []
    left_out: list[Exclusion] = []
    for body in moved_bodies(real):
        for side in sides:
            compared = compare_bodies(real, side, body)
            if not compared:
                continue
            found = body_measurements(task, side.name, body, compared)
            measurements += found
            rows.append(_row(body, side, compared, found))
            left_out += _fitted(side, compared) if body != TOOL_BODY else []
    tables = (
        Table.of(
            rows,
            id=table_id,
            title=f"End points: {task}",
            note="Medians over recorded runs. A replay is compared with the run that it was made "
            "from, other simulated runs with every recorded one (mean over them). Displacement: "
            "end minus start, so where a body began plays no part. Intervals of the end point: "
            "order statistics, 95 %. Runs that something was fitted to do not count.",
        ),
    )
    return Part(
        measurements=tuple(measurements),
        tables=tables if rows else (),
        exclusions=tuple(dict.fromkeys(left_out)),
    )


def _row(
    body: str, side: Side, compared: Sequence[BodyComparison], found: Sequence[Measurement]
) -> dict[str, Cell]:
    by_name = dict(zip(BODY_DISTANCES, found, strict=True))
    low, high = ends(by_name["end_point_m"].interval, 1e3)
    return {
        "body": body,
        "engine": side.name,
        "recorded runs": by_name["end_point_m"].n,
        "fitted to": sum(item.fitted for item in compared),
        "end-point error (mm)": millimetres(by_name["end_point_m"].value),
        "low (mm)": None if low is None else round(low, 2),
        "high (mm)": None if high is None else round(high, 2),
        "displacement error (mm)": millimetres(by_name["displacement_m"].value),
        "error over normalised time (mm)": millimetres(by_name["over_time_m"].value),
        "the same, moving part (mm)": millimetres(by_name["moving_over_time_m"].value),
    }


def _fitted(side: Side, compared: Sequence[BodyComparison]) -> list[Exclusion]:
    reason = f"the replays of {side.name} were fitted to this run; only held-out runs count"
    return [
        Exclusion(episode=item.recorded, scope="end points", reason=reason)
        for item in compared
        if item.fitted
    ]


FITTED_TO = "fitted_to"
"""Setting of a replay: ids of the recorded runs from which something was identified."""


def compare_imported(recorded: Sequence[Episode], files: Sequence[DerivedFile]) -> Part:
    """Compare where tool and objects of imported runs end, per task and simulation engine."""
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
        track = _tcp_track(episode)
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


def _tcp_track(episode: Episode) -> PoseTrajectory | None:
    """Return the tool centre point's poses, or None where they were not recorded."""
    topics = [
        topic for topic in episode.topics_of_type(schema.POSE_STAMPED) if topic.endswith(TCP_POSE)
    ]
    try:
        return pose_track(episode, topics[0]) if topics else None
    except BridgeError:
        return None


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
