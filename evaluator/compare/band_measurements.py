"""Numbers of recorded against simulated runs of one motion."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median

import numpy as np

from bridge.geometry.trajectory import PoseTrajectory
from evaluator.compare.measure import interval_or_reason, measured, slug
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import (
    MOVING_THRESHOLD_M,
    BandDistance,
    Repeatability,
    band_distance,
    mean_curve_m,
    moving_part,
    path_distance_m,
    repeatability,
    without_rigid_motion,
)
from evaluator.result import Interval, Measurement
from evaluator.statistics.intervals import median_interval

NO_INTERVAL = "the runs' own spread is the repeatability beside it"
WHOLE = "whole recordings, waiting at their ends included"
MOVING = (
    "the moving part only, from leaving the start to arriving at the end, each within "
    f"{MOVING_THRESHOLD_M * 1000:.0f} mm"
)
BAND_WIDTH = 2.0
"""The recorded band reaches this many of its root mean square distances from its mean curve."""

DISTANCES: tuple[tuple[str, str, str], ...] = (
    (
        "mean_over_pairs_m",
        "m",
        "distance over normalised time, mean over all (recorded, simulated) pairs of runs",
    ),
    ("between_mean_curves_m", "m", "distance of the two mean curves, mean over normalised time"),
    ("max_between_mean_curves_m", "m", "largest distance of the two mean curves"),
    ("end_point_over_pairs_m", "m", "distance of the end points, mean over all pairs of runs"),
    ("end_point_between_means_m", "m", "distance of the mean end points"),
    (
        "turned_over_pairs_rad",
        "rad",
        "angle between what both turned since they began, over normalised time, mean over all "
        "(recorded, simulated) pairs of runs",
    ),
)
SPREADS: tuple[tuple[str, str], ...] = (
    ("mean_m", "root mean square distance from the mean curve, mean over normalised time"),
    ("worst_m", "root mean square distance from the mean curve at its worst instant"),
    ("end_point_m", "root mean square distance from the mean end point"),
)


@dataclass(frozen=True, kw_only=True)
class Run:
    """One imported run."""

    episode: str
    task: str
    engine: str | None
    """None for a recorded run."""
    track: PoseTrajectory


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


def distance_measurements(task: str, real: Side, simulated: Side) -> list[Measurement]:
    """Measure how far two bands lie apart, whole and moving part."""
    measurements = []
    what = f"end effector, {len(real.runs)} recorded against {len(simulated.runs)} "
    what += f"{simulated.name} runs, unpaired"
    for prefix, part, cut in (("", WHOLE, _whole), ("moving_", MOVING, moving_part)):
        distance = band_distance(real.tracks(cut), simulated.tracks(cut))
        make = partial(measured, episodes=[*real.episodes, *simulated.episodes])
        first = f"bands.{slug(task)}.{slug(simulated.name)}.{prefix}"
        measurements += [
            make(
                f"{first}{name}",
                partial(_field, distance, name),
                unit=unit,
                definition=f"{what}: {words}; {part}",
                n=len(real.runs) * len(simulated.runs),
                counted="pair of runs",
                reason_without_interval=NO_INTERVAL,
            )
            for name, unit, words in DISTANCES
        ]
        _, why_none = interval_or_reason(median_interval, distance.of_recorded_m)
        measurements.append(
            make(
                f"{first}median_over_recorded_m",
                partial(_median, distance.of_recorded_m),
                unit="m",
                definition=f"{what}: median over recorded runs of the mean distance to these "
                f"simulated runs, so where another recorded run would lie; {part}",
                n=len(real.runs),
                counted="run",
                reason_without_interval=why_none,
            )
        )
    return [*measurements, *_shape(task, real, simulated, what)]


def _shape(task: str, real: Side, simulated: Side, what: str) -> list[Measurement]:
    """Measure the moving parts without their speed, and without a constant offset."""
    tracks = real.tracks(moving_part), simulated.tracks(moving_part)
    make = partial(
        measured,
        unit="m",
        n=len(real.runs) * len(simulated.runs),
        counted="pair of runs",
        reason_without_interval=NO_INTERVAL,
        episodes=[*real.episodes, *simulated.episodes],
    )
    first = f"bands.{slug(task)}.{slug(simulated.name)}.moving_"
    return [
        make(
            f"{first}along_path_m",
            lambda: path_distance_m(*tracks),
            definition=f"{what}: distance at equal shares of the way, whatever the speed, mean "
            f"over all (recorded, simulated) pairs of runs; {MOVING}",
        ),
        make(
            f"{first}without_offset_m",
            lambda: float(without_rigid_motion(*(mean_curve_m(side) for side in tracks)).mean()),
            definition=f"{what}: distance of the two mean curves after the best rigid motion is "
            f"taken out, mean over normalised time; {MOVING}",
        ),
    ]


def inside_band(task: str, real: Side, simulated: Side) -> list[Measurement]:
    """Measure how much of the time a simulated mean curve lies within the recorded band."""

    def share() -> float:
        tracks = real.tracks(moving_part)
        allowed = BAND_WIDTH * repeatability(tracks).profile_m
        distance = band_distance(tracks, simulated.tracks(moving_part)).profile_m
        return float(np.mean(distance <= allowed))

    return [
        measured(
            f"bands.{slug(task)}.{slug(simulated.name)}.moving_inside_band",
            share,
            unit="1",
            definition="share of normalised time in which the simulated mean curve is nearer to "
            f"the recorded one than {BAND_WIDTH:g} root mean square distances of the recorded runs "
            f"from it; {MOVING}",
            n=len(real.runs),
            counted="run",
            reason_without_interval=NO_INTERVAL,
            episodes=[*real.episodes, *simulated.episodes],
        )
    ]


def spread_measurements(task: str, side: Side) -> list[Measurement]:
    """Measure how far the runs of one side stray from their own mean."""
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
            f"repeatability.{slug(task)}.{slug(side.name)}.{name}",
            partial(read, name),
            unit="m",
            definition=f"end effector, spread of {len(side.runs)} {side.name} runs: {words}",
            n=len(side.runs),
            counted="run",
            reason_without_interval="not estimated",
            episodes=side.episodes,
        )
        for name, words in SPREADS
    ]


def _whole(track: PoseTrajectory) -> PoseTrajectory:
    return track


def _field(record: BandDistance | Repeatability, name: str) -> float:
    return float(getattr(record, name))


def _median(values: Sequence[float]) -> tuple[float, Interval | None]:
    return float(median(values)), interval_or_reason(median_interval, values)[0]
