"""How far the recorded tool centre point lies from the replayed one, summed up over trials."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from evaluator.compare.measure import measured
from evaluator.compare.rows import TcpErrorSeries, TrialRow
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Measurement

SUMMARIES: tuple[tuple[str, str, str, Callable[[TcpErrorSeries], float]], ...] = (
    ("position_mean_m", "m", "mean distance over time", lambda s: float(s.position_m.mean())),
    ("position_max_m", "m", "largest distance over time", lambda s: float(s.position_m.max())),
    ("end_point_m", "m", "distance at the last common instant", lambda s: float(s.position_m[-1])),
    ("rotation_mean_rad", "rad", "mean angle over time", lambda s: float(s.rotation_rad.mean())),
)

MEANING = {
    "planned": "what was commanded; the controller's tracking error and delay",
    "executed": "the joints the robot reported; kinematics and base calibration",
}


def tcp_measurements(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Measure recorded against replayed tool poses at matching stamps, mean over trials."""
    measurements = []
    for against, meaning in MEANING.items():
        found = [
            (row.episode, series)
            for row in rows
            for series in row.tcp_errors
            if series.against == against
        ]
        for name, unit, words, summary in SUMMARIES:
            measurements.append(
                measured(
                    f"tcp.{against}.{name}",
                    partial(_mean, [summary(series) for _, series in found], against),
                    unit=unit,
                    definition=f"recorded tool centre point against the {against} replay at the "
                    f"same instants ({meaning}): {words}, mean over trials",
                    n=len(found),
                    counted="trial",
                    reason_without_interval="not computed: trials share one calibration",
                    episodes=[episode for episode, _ in found],
                )
            )
    return measurements


def _mean(values: Sequence[float], against: str) -> float:
    if not values:
        raise UndefinedStatisticError(
            statistic="tool error",
            reason=f"no trial has both a recorded tool pose and a replay of the {against} one",
        )
    return float(np.mean(values))
