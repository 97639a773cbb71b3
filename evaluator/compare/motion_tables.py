"""Motion errors as tables: per task, over time, and where they are largest."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from evaluator.compare.in_tables import average, degrees, millimetres, milliseconds
from evaluator.compare.motion import MotionSummary
from evaluator.packed import Packed
from evaluator.result import Cell, Table

Groups = Mapping[str, Sequence[MotionSummary]]
"""By what the motions are held against: planned, executed, or twin."""
OVER_TIME = range(0, 101, 10)
"""Places on the curves that the table shows, in percent of the duration."""
NUM_WORST = 3


def cell_table(groups: Groups) -> Table:
    """Means of each task and condition."""
    rows: list[tuple[Cell, ...]] = []
    for name, motions in groups.items():
        cells: dict[tuple[str, str], list[MotionSummary]] = {}
        for motion in motions:
            cells.setdefault((motion.task, motion.condition), []).append(motion)
        for task, condition in sorted(cells):
            cell = cells[task, condition]
            rows.append(
                (
                    task,
                    condition.replace("_", " "),
                    name,
                    len(cell),
                    millimetres(average(cell, lambda m: m.position_mean_m)),
                    millimetres(average(cell, lambda m: m.end_point_m)),
                    degrees(average(cell, lambda m: m.rotation_mean_rad)),
                    milliseconds(average(cell, lambda m: m.lag_s)),
                    millimetres(average(cell, lambda m: m.without_lag_mean_m)),
                    millimetres(average(cell, lambda m: m.without_offset_mean_m)),
                    degrees(average(cell, lambda m: m.joint_rms_rad)),
                )
            )
    return Table(
        id="motion",
        title="Recorded, planned and executed motions",
        columns=(
            "task",
            "condition",
            "against",
            "trials",
            "mean distance (mm)",
            "end point (mm)",
            "mean angle (deg)",
            "delay (ms)",
            "without delay (mm)",
            "without offset (mm)",
            "joints, RMS (deg)",
        ),
        rows=tuple(rows),
        note="Tool centre point, means over trials. Planned, executed: recorded against that "
        "replay. Twin: executed against planned replay. Without delay: the recorded motion shifted "
        "in time; without offset: laid over by a rigid motion too.",
    )


def over_time_table(groups: Groups) -> Table:
    """Errors at eleven places of the execution."""
    rows: list[tuple[Cell, ...]] = []
    for name, motions in groups.items():
        if not motions:
            continue
        tool = _stacked([motion.curve_m for motion in motions])
        joints = _stacked([m.joint_curve_rad for m in motions if m.joint_curve_rad])
        for place in OVER_TIME:
            arm = degrees(float(joints[:, place].mean())) if len(joints) else None
            mean = millimetres(float(tool[:, place].mean()))
            largest = millimetres(float(tool[:, place].max()))
            rows.append((name, place, len(tool), mean, largest, arm))
    return Table(
        id="motion_over_time",
        title="Motion errors over time",
        columns=(
            "against",
            "time (% of the execution)",
            "trials",
            "mean distance (mm)",
            "largest (mm)",
            "joints, mean of RMS (deg)",
        ),
        rows=tuple(rows),
        note="From the first to the last instant that both sides of a trial know.",
    )


def _stacked(curves: Sequence[Packed]) -> Float[np.ndarray, "num_curves num_places"]:
    """Stack curves of one length."""
    flat = np.frombuffer(b"".join(curves), dtype=np.float64)
    return flat.reshape(len(curves), -1) if curves else flat.reshape(0, 0)


def worst_table(groups: Groups) -> Table:
    """The trials with the largest distances."""
    rows: list[tuple[Cell, ...]] = []
    for name, motions in groups.items():
        far = sorted(motions, key=lambda motion: -motion.position_max_m)[:NUM_WORST]
        rows += [
            (
                name,
                motion.episode,
                motion.aligned_by,
                millimetres(motion.position_max_m),
                millimetres(motion.position_mean_m),
                motion.joint_worst,
                degrees(motion.joint_max_rad),
            )
            for motion in far
        ]
    return Table(
        id="motion_worst",
        title="The largest motion errors",
        columns=(
            "against",
            "episode",
            "aligned by",
            "largest distance (mm)",
            "mean distance (mm)",
            "worst joint",
            "its error (deg)",
        ),
        rows=tuple(rows),
        note="The three trials with the largest distance.",
    )
