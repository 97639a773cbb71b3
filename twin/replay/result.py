"""What a replay says: states over time and the verdict."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.task.predicate import Rollout
from bridge.task.verdict import Verdict


@dataclass(frozen=True, kw_only=True)
class Contact:
    """One stretch of time in which two bodies were closer than the margin."""

    start_ns: int
    end_ns: int
    bodies: tuple[str, str]
    allowed: bool
    """Whether the active stage allowed them to touch."""
    min_distance_m: float


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """States at ``stamps_ns`` after the start of the trajectory, settling included."""

    verdict: Verdict
    stamps_ns: Int[np.ndarray, " num_steps"]
    joints_rad: Float[np.ndarray, "num_steps num_joints"]
    width_m: Float[np.ndarray, " num_steps"]
    Ts_base_tcp: Float[np.ndarray, "num_steps 4 4"]
    Ts_base_object: dict[str, Float[np.ndarray, "num_steps 4 4"]]
    """Objects whose motion the replay knows; a kinematic replay knows none that can move."""
    finger_contact: dict[str, Bool[np.ndarray, " num_steps"]]
    clearance_m: Float[np.ndarray, " num_steps"]
    """Smallest signed distance over the pairs that may not touch [m]."""
    contacts: list[Contact]

    def rollout(self) -> Rollout:
        """The states the success predicate reads."""
        return Rollout(
            stamps_ns=self.stamps_ns,
            Ts_base_object=self.Ts_base_object,
            finger_contact=self.finger_contact,
        )
