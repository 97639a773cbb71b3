"""What a replay says: states over time and the verdict, and when something holds in them."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from bridge.geometry.signals import runs_of_true
from bridge.task.predicate import Contact, Rollout
from bridge.task.verdict import Verdict


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
    nodes_m: dict[str, Float32[np.ndarray, "num_steps _ 3"]] = field(default_factory=dict)
    """Soft objects: where their nodes are, base frame [m]."""
    extents_m: dict[str, Float[np.ndarray, "num_steps 3"]] = field(default_factory=dict)
    """Soft objects: outer extents along their own axes [m]."""
    broken: dict[str, str] = field(default_factory=dict)
    """Soft objects that burst or turned inside out, and what was found."""

    def rollout(self) -> Rollout:
        """The states the success predicate reads."""
        return Rollout(
            stamps_ns=self.stamps_ns,
            Ts_base_object=self.Ts_base_object,
            finger_contact=self.finger_contact,
            extents_m=self.extents_m,
            broken=self.broken,
            contacts=self.contacts,
        )


def stretches_ns(
    stamps_ns: Int[np.ndarray, " num_steps"], flags: Bool[np.ndarray, " num_steps"]
) -> list[tuple[int, int]]:
    """First and last stamp of each run of True."""
    return [(int(stamps_ns[first]), int(stamps_ns[end - 1])) for first, end in runs_of_true(flags)]
