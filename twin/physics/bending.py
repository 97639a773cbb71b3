"""What the core asks of soft bodies; the leaf ``soft`` answers."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32


@runtime_checkable
class SoftShape(Protocol):
    """A soft body at rest, in the frame of its object."""

    @property
    def nodes_m(self) -> Float32[np.ndarray, "num_nodes 3"]:
        """Its nodes."""


@runtime_checkable
class SoftHealth(Protocol):
    """Whether a soft body is still what it was."""

    @property
    def sound(self) -> bool:
        """Nothing burst and nothing is inside out."""

    @property
    def burst(self) -> bool:
        """It is no body any more; what comes after is noise."""

    def describe(self) -> str:
        """Say about what is wrong; empty when nothing is."""


@runtime_checkable
class SoftBodies(Protocol):
    """The soft part of a world, on the clock of the rigid one."""

    def add(
        self, object_id: str, model: SoftShape, T_base_object: Float[np.ndarray, "4 4"]
    ) -> None:
        """Add a soft body at rest, undeformed."""

    def place_links(self) -> None:
        """Take the robot's links to be where they are now, without having moved there."""

    def push_rigid(self) -> None:
        """Hand to the robot what the soft bodies did in the last step."""

    def step(self) -> None:
        """Advance the soft bodies to where the rigid ones are."""

    @property
    def names(self) -> dict[str, object]:
        """The soft bodies."""

    def nodes_m(self, object_id: str) -> Float[np.ndarray, "num_nodes 3"]:
        """Where a body's nodes are."""

    def extents_m(self, object_id: str) -> Float[np.ndarray, "3"]:
        """Extents of a body's surface along the axes of its pose."""

    def T_base_object(self, object_id: str) -> Float[np.ndarray, "4 4"]:
        """The rigid motion nearest to a body's nodes; of one that burst no numbers."""

    def health(self, object_id: str) -> SoftHealth:
        """Whether a body is sound."""

    def finger_touches(self, object_id: str) -> bool:
        """Whether a finger touched a body in the last step."""
