"""One episode as the calibration sees it: what the robot did, and what was observed of objects."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.task.task_file import Task
from twin.errors import TwinError

TIPPED = 0.7
PLANAR = (0, 1, 5)
"""Of a localisation's covariance: x, y and the turn about the vertical."""


class UnusableCaseError(TwinError):
    """An episode from which nothing can be learned about physics."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One executed plan. Times count from its start."""

    episode: str
    """Id and content hash of the episode, for the record."""
    sha256: str
    kind: str
    """Which probe it is, or ``trial``: cases are held out kind by kind."""
    task: Task
    urdf: str
    joint_times_s: Float[np.ndarray, " num_samples"]
    joints_rad: Float[np.ndarray, "num_samples num_joints"]
    width_times_s: Float[np.ndarray, " num_commands"]
    width_commands_m: Float[np.ndarray, " num_commands"]
    """Each holds until the next one."""
    stretches_s: Float[np.ndarray, "num_stretches 2"]
    """From when to when the gripper is near an object or holds one; in between nothing moves."""
    Ts_base_start: dict[str, Float[np.ndarray, "4 4"]]
    """Localised poses of every object before the plan, containers included."""
    objects: tuple[str, ...]
    """Those that move, in the order of the arrays below."""
    start_covariance: Float[np.ndarray, "num_objects 3 3"]
    """Of x, y and turn [m^2, m rad, rad^2]."""
    settled: Float[np.ndarray, "num_objects 3"]
    """Localised x, y and turn afterwards; NaN where an object was not found."""
    settled_covariance: Float[np.ndarray, "num_objects 3 3"]
    turn_period_rad: Float[np.ndarray, " num_objects"]
    """After such a turn an object looks the same."""
    hold_times_s: Float[np.ndarray, " num_holds"]
    """When the fingers stood still on something although they were told to close further."""
    held_widths_m: Float[np.ndarray, " num_holds"]
    success: bool | None
    """What the operator said of a trial; None: a probe, or unknown."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """What one living-through of a case says about the same observations."""

    settled: Float[np.ndarray, "num_objects 3"]
    held_widths_m: Float[np.ndarray, " num_holds"]
    success: float
    """Share of noisy starts that succeed; NaN where nobody asks."""


def planar(T_base_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
    """Position on the table and turn about the vertical of a pose.

    For a box that stands on its x axis, the turn is that of its y axis.
    """
    R = T_base_object[:3, :3]
    level = 0 if abs(R[2, 0]) < TIPPED else 1
    return np.array([*T_base_object[:2, 3], np.arctan2(R[1, level], R[0, level])])
