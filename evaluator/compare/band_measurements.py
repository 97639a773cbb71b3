"""Numbers of recorded against simulated runs of one motion."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median

import numpy as np
from jaxtyping import Float

from bridge.geometry.trajectory import PoseTrajectory
from evaluator.compare.measure import interval_or_reason, measured
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import (
    BandDistance,
    Repeatability,
    band_distance,
    mean_curve_m,
    moving_part,
    path_distance_m,
    repeatability,
    without_rigid_motion,
)
from evaluator.motion_measurements import (
    BAND_ALONG_PATH,
    BAND_DISTANCES,
    BAND_MEDIAN,
    BAND_WIDTH,
    BAND_WITHOUT_OFFSET,
    INSIDE_BAND,
    REPEATABILITY,
)
from evaluator.result import Interval, Measurement
from evaluator.statistics.intervals import median_interval

NO_INTERVAL = "the runs' own spread is the repeatability beside it"


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
        return self.track if name == "tool" else self.objects.get(name)


@dataclass(frozen=True, kw_only=True)
class Side:
    """Runs of one task that are compared as one band."""

    name: str
    """``recorded``, or the engine."""
    runs: tuple[Run, ...]

    def tracks(
        self, cut: Callable[[PoseTrajectory], PoseTrajectory] = lambda track: track
    ) -> list[PoseTrajectory]:
        """Their motions, perhaps cut."""
        return [cut(run.track) for run in self.runs]

    @property
    def episodes(self) -> list[str]:
        """Their episodes."""
        return [run.episode for run in self.runs]


@dataclass(frozen=True, kw_only=True)
class BandCurve:
    """Distance of two mean curves over normalised time, with what each side strays."""

    task: str
    engine: str
    part: str
    """``whole`` recordings, or the ``moving`` part alone."""
    num_recorded: int
    num_simulated: int
    distance_m: tuple[float, ...]
    """Between the mean curves, at 101 instants."""
    recorded_spread_m: tuple[float, ...]
    """Root mean square distance from the recorded mean curve; empty with a single run."""
    simulated_spread_m: tuple[float, ...]


PATH_SAMPLES = 51
"""Instants of normalised time at which paths are kept for drawing."""
Path3 = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, kw_only=True)
class BandPath:
    """Where a body went in the runs of one side: mean curve over the moving part, and reach."""

    task: str
    body: str
    """``tool``, or an object."""
    side: str
    """``recorded``, or the engine."""
    num_runs: int
    mean_m: Path3
    low_m: Path3
    """Least coordinates of any run, at each instant."""
    high_m: Path3


def band_paths(task: str, sides: Sequence[Side]) -> list[BandPath]:
    """Lay out where the tool and each object went on each side.

    Args:
        task: Task of the runs.
        sides: Recorded runs and those of each engine; a body that a side has not is left out.
    """
    names = dict.fromkeys(name for side in sides for run in side.runs for name in run.objects)
    paths = []
    for body in ("tool", *names):
        for side in sides:
            tracks = [track for run in side.runs if (track := run.body(body)) is not None]
            if not tracks:
                continue
            runs_m = np.stack(
                [moving_part(track).normalised_time(PATH_SAMPLES).p_m for track in tracks]
            )
            paths.append(
                BandPath(
                    task=task,
                    body=body,
                    side=side.name,
                    num_runs=len(tracks),
                    mean_m=_points(runs_m.mean(axis=0)),
                    low_m=_points(runs_m.min(axis=0)),
                    high_m=_points(runs_m.max(axis=0)),
                )
            )
    return paths


def _points(curve_m: Float[np.ndarray, "num_samples 3"]) -> Path3:
    return tuple((x, y, z) for x, y, z in curve_m.tolist())


def distance_measurements(task: str, real: Side, simulated: Side) -> list[Measurement]:
    """Measure how far two bands lie apart, whole and moving part.

    Args:
        task: Task of the runs, a part of the ids.
        real: Recorded runs.
        simulated: Runs of one engine.
    """
    measurements = []
    what = f"end effector, {len(real.runs)} recorded against {len(simulated.runs)} "
    what += f"{simulated.name} runs, unpaired"
    parts = {"task": task, "engine": simulated.name, "what": what}
    for prefix, cut in (("", _whole), ("moving_", moving_part)):
        distance = band_distance(real.tracks(cut), simulated.tracks(cut))
        make = partial(measured, episodes=[*real.episodes, *simulated.episodes])
        measurements += [
            make(
                quantity.of(**parts),
                partial(_field, distance, name),
                n=len(real.runs) * len(simulated.runs),
                counted="pair of runs",
                reason_without_interval=NO_INTERVAL,
            )
            for name, quantity in BAND_DISTANCES[prefix].items()
        ]
        _, why_none = interval_or_reason(median_interval, distance.of_recorded_m)
        measurements.append(
            make(
                BAND_MEDIAN[prefix].of(**parts),
                partial(_median, distance.of_recorded_m),
                n=len(real.runs),
                counted="run",
                reason_without_interval=why_none,
            )
        )
    return [*measurements, *_shape(real, simulated, parts)]


def _shape(real: Side, simulated: Side, parts: dict[str, str]) -> list[Measurement]:
    """Measure the moving parts without their speed, and without a constant offset."""
    tracks = real.tracks(moving_part), simulated.tracks(moving_part)
    make = partial(
        measured,
        n=len(real.runs) * len(simulated.runs),
        counted="pair of runs",
        reason_without_interval=NO_INTERVAL,
        episodes=[*real.episodes, *simulated.episodes],
    )
    return [
        make(
            BAND_ALONG_PATH.of(**parts),
            lambda: path_distance_m(*tracks),
        ),
        make(
            BAND_WITHOUT_OFFSET.of(**parts),
            lambda: float(without_rigid_motion(*(mean_curve_m(side) for side in tracks)).mean()),
        ),
    ]


def inside_band(task: str, real: Side, simulated: Side) -> list[Measurement]:
    """Measure how much of the time a simulated mean curve lies within the recorded band.

    Args:
        task: Task of the runs, a part of the ids.
        real: Recorded runs; their spread gives the band its width.
        simulated: Runs of one engine.
    """

    def share() -> float:
        tracks = real.tracks(moving_part)
        allowed = BAND_WIDTH * repeatability(tracks).profile_m
        distance = band_distance(tracks, simulated.tracks(moving_part)).profile_m
        return float(np.mean(distance <= allowed))

    return [
        measured(
            INSIDE_BAND.of(task=task, engine=simulated.name),
            share,
            n=len(real.runs),
            counted="run",
            reason_without_interval=NO_INTERVAL,
            episodes=[*real.episodes, *simulated.episodes],
        )
    ]


def spread_measurements(task: str, side: Side) -> list[Measurement]:
    """Measure how far the runs of one side stray from their own mean.

    Args:
        task: Task of the runs, a part of the ids.
        side: Recorded runs, or those of one engine.
    """
    spread: Repeatability | None = None
    refusal: UndefinedStatisticError | None = None
    try:
        spread = repeatability(side.tracks())
    except UndefinedStatisticError as error:
        refusal = error

    def read(name: str) -> float:
        if spread is None:
            raise refusal or UndefinedStatisticError(statistic="repeatability", reason="no run")
        return _field(spread, name)

    return [
        measured(
            quantity.of(task=task, side=side.name, count=len(side.runs)),
            partial(read, name),
            n=len(side.runs),
            counted="run",
            reason_without_interval="not estimated",
            episodes=side.episodes,
        )
        for name, quantity in REPEATABILITY.items()
    ]


def _whole(track: PoseTrajectory) -> PoseTrajectory:
    return track


def _field(record: BandDistance | Repeatability, name: str) -> float:
    return float(getattr(record, name))


def _median(values: Sequence[float]) -> tuple[float, Interval | None]:
    return float(median(values)), interval_or_reason(median_interval, values)[0]
