"""How far recorded and replayed motions of the arm lie apart, summed up over trials."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from evaluator.compare.measure import measured
from evaluator.compare.motion import EXECUTED, PLANNED, RECORDED, MotionSummary
from evaluator.compare.motion_tables import cell_table, over_time_table, worst_table
from evaluator.compare.part import Part
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Measurement

Read = Callable[[MotionSummary], float | None]

TWIN = "twin"
MEANING = {
    PLANNED: "recorded against the planned replay (what was commanded; the controller's tracking "
    "error and delay)",
    EXECUTED: "recorded against the executed replay (the joints the robot reported; kinematics and "
    "base calibration)",
    TWIN: "executed against planned replay (what reached the twin's objects differently)",
}
TOOL = "tool centre point"
QUANTITIES: tuple[tuple[str, str, str, str, Read], ...] = (
    ("position_mean_m", "m", TOOL, "mean distance over time", lambda s: s.position_mean_m),
    ("position_max_m", "m", TOOL, "largest distance over time", lambda s: s.position_max_m),
    ("end_point_m", "m", TOOL, "distance at the last common instant", lambda s: s.end_point_m),
    ("rotation_mean_rad", "rad", TOOL, "mean angle over time", lambda s: s.rotation_mean_rad),
    ("rotation_max_rad", "rad", TOOL, "largest angle over time", lambda s: s.rotation_max_rad),
    ("end_point_rad", "rad", TOOL, "angle at the last common instant", lambda s: s.end_point_rad),
    (
        "lag_s",
        "s",
        TOOL,
        "delay of least distance, a rigid motion apart",
        lambda s: s.lag_s,
    ),
    (
        "without_lag_mean_m",
        "m",
        TOOL,
        "mean distance after that delay is taken out",
        lambda s: s.without_lag_mean_m,
    ),
    (
        "without_offset_mean_m",
        "m",
        TOOL,
        "mean distance after delay and best rigid motion are taken out",
        lambda s: s.without_offset_mean_m,
    ),
    (
        "relative_mean_m",
        "m",
        TOOL,
        "mean difference of what both do within one second",
        lambda s: s.relative_mean_m,
    ),
    ("joint_rms_rad", "rad", "joints", "root mean square error", lambda s: s.joint_rms_rad),
    ("joint_max_rad", "rad", "joints", "largest error of any joint", lambda s: s.joint_max_rad),
)
SHARED = "not computed: trials share one calibration"


def motion_results(motions: Sequence[MotionSummary]) -> Part:
    """Measure recorded against replayed motions, mean over trials, and their errors over time."""
    if not motions:
        reason = "no trial has both a recorded tool pose and a dynamic replay's"
        return Part(missing=(f"motion errors: no data ({reason})",))
    groups: dict[str, list[MotionSummary]] = {name: [] for name in MEANING}
    for motion in motions:
        groups[motion.against if motion.side == RECORDED else TWIN].append(motion)
    found = [m for name, members in groups.items() for m in _measure(name, members)]
    return Part(
        measurements=tuple(found),
        tables=(cell_table(groups), over_time_table(groups), worst_table(groups)),
    )


def _measure(name: str, motions: Sequence[MotionSummary]) -> list[Measurement]:
    how = sorted({motion.aligned_by for motion in motions})
    measurements = []
    for quantity, unit, what, words, read in QUANTITIES:
        known = [(m.episode, value) for m in motions if (value := read(m)) is not None]
        measurements.append(
            measured(
                f"motion.{name}.{quantity}",
                partial(_mean, [value for _, value in known], name),
                unit=unit,
                definition=f"{what}, {MEANING[name]}: {words}, mean over trials; aligned by "
                f"{' or '.join(how) or 'stamps'}",
                n=len(known),
                counted="trial",
                reason_without_interval=SHARED,
                episodes=[episode for episode, _ in known],
            )
        )
    return measurements


def _mean(values: Sequence[float], name: str) -> float:
    if not values:
        raise UndefinedStatisticError(
            statistic="motion error", reason=f"no trial knows it of {MEANING[name].split(' (')[0]}"
        )
    return float(np.mean(values))
