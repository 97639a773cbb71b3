"""Whether objects are still where a verdict took them to be."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.task.task_file import ObjectModel, Task
from twin.scene.shape.known import yaw_period_rad

SIGMAS = 4.0
"""What localisation says of its own errors, so many times, is no motion."""


def who_moved(
    before: Mapping[str, Any],
    after: Mapping[str, Any],
    task: Task,
    *,
    moved_m: float,
    moved_rad: float,
) -> list[str]:
    """Name the objects that lie elsewhere than before, with how far.

    Args:
        before: Objects as localised for the verdict.
        after: As localised just now.
        task: Knows which turns look the same.
        moved_m: Shift that counts [m], unless localisation is less sure than that.
        moved_rad: Turn about the vertical that counts [rad], unless it is less sure than that.
    """
    told = []
    for name, old in before.items():
        new = after[name]
        shift_m = float(np.linalg.norm(new.T_base_object[:3, 3] - old.T_base_object[:3, 3]))
        turn_rad = turn_between(old.T_base_object, new.T_base_object, task.objects[name])
        sigma_m, sigma_rad = _sigmas(old)
        near = shift_m <= max(moved_m, SIGMAS * sigma_m)
        if not (near and turn_rad <= max(moved_rad, SIGMAS * sigma_rad)):  # also what is no number
            told.append(f"{name} by {shift_m * 1e3:.0f} mm and {np.degrees(turn_rad):.0f} degrees")
    return told


def turn_between(
    T_first: Float[np.ndarray, "4 4"], T_second: Float[np.ndarray, "4 4"], model: ObjectModel
) -> float:
    """Turn about the vertical from one pose to another, among those that look the same [rad]."""
    period = 2 * np.pi if model.soft is not None else yaw_period_rad(model)
    yaws = [np.arctan2(T[1, 0], T[0, 0]) for T in (T_first, T_second)]
    return float(abs(np.mod(yaws[1] - yaws[0] + period / 2, period) - period / 2))


def _sigmas(item: Any) -> tuple[float, float]:
    covariance = getattr(item, "covariance", None)
    if covariance is None:
        return 0.0, 0.0
    return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.sqrt(covariance[5, 5]))
