"""What a replay says: states over time and the verdict, and when something holds in them."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from bridge.geometry.signals import runs_of_true
from bridge.task.predicate import Rollout
from bridge.task.verdict import Verdict


@dataclass(frozen=True, kw_only=True)
class Burst:
    """A soft body that stopped being one."""

    object_id: str
    t_ns: int
    found: str


@dataclass(frozen=True, kw_only=True)
class States(Rollout):
    """What a replay saw from the start of the trajectory on, settling included.

    Objects are those whose motion it knows; a kinematic replay knows none that can move.
    """

    joints_rad: Float[np.ndarray, "num_steps num_joints"]
    width_m: Float[np.ndarray, " num_steps"]
    nodes_m: dict[str, Float32[np.ndarray, "num_steps _ 3"]] = field(default_factory=dict)
    """Of soft objects, base frame [m]."""
    burst: Burst | None = None
    """The first that burst; the replay ended there."""
    arm_force_N: Float[np.ndarray, " _"] = field(default_factory=lambda: np.zeros(0))
    """What rigid bodies press the arm with, where physics was asked."""


@dataclass(frozen=True, kw_only=True)
class ReplayResult(States):
    """States with what was made of them."""

    verdict: Verdict
    Ts_base_tcp: Float[np.ndarray, "num_steps 4 4"]
    clearance_m: Float[np.ndarray, " num_steps"]
    """Smallest signed distance over the pairs that may not touch [m]."""


def stretches_ns(
    stamps_ns: Int[np.ndarray, " num_steps"], flags: Bool[np.ndarray, " num_steps"]
) -> list[tuple[int, int]]:
    """First and last stamp of each run of True."""
    return [(int(stamps_ns[first]), int(stamps_ns[end - 1])) for first, end in runs_of_true(flags)]
