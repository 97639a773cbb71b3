"""What a replay happens in: the task, where its objects were, and the robot."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from bridge.task.task_file import Task
from twin.replay.failure import with_reasons
from twin.scene.shape.static import StaticSdf


@dataclass(frozen=True, kw_only=True)
class ReplayScene:
    """One start state. Objects that were not found are absent, never guessed."""

    task: Task
    Ts_base_object: dict[str, Float[np.ndarray, "4 4"]]
    """Start poses of the objects that were localised, containers included."""
    urdf: str
    """The robot description, package URIs allowed."""
    scene_hash: str | None = None
    """Content hash of the rebuilt scene; None when there is none."""
    table_height_m: float = 0.0
    """Height of the table top in the robot's base frame [m]."""

    reasons: Mapping[str, str] = field(default_factory=dict)
    """Why an object has no pose."""
    covariances: Mapping[str, Float[np.ndarray, "6 6"]] = field(default_factory=dict)
    """How sure each start pose is: (x, y, z, rotation about x, y, z), base frame; what samples are
    drawn from."""
    calibration_id: str | None = None
    """The calibration whose physics is used; None when there is none."""
    static_sdf: StaticSdf | None = None
    """Distances to what stands still; None: only the table and the containers are known."""
    lattices: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    """Soft objects by the arrays of the scene's ``soft.npz``; the task's mesh stands in for
    others."""
    shape_sources: Mapping[str, str] = field(default_factory=dict)
    """Per object: where its shape comes from."""

    def missing(self) -> list[str]:
        """Objects of the task that have no pose."""
        return [name for name in self.task.objects if name not in self.Ts_base_object]

    def describe_missing(self) -> str:
        """Name the objects without a pose, with the reasons where they are known."""
        why = {name: self.reasons.get(name) for name in self.missing()}
        return f"not localised: {with_reasons(why)}"

    def containers(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Poses of the objects that stand still: containers and those declared fixed."""
        return {
            name: T
            for name, T in self.Ts_base_object.items()
            if name in self.task.containers or self.task.objects[name].fixed
        }

    def movable(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Poses of the objects that a trajectory may move."""
        still = self.containers()
        return {name: T for name, T in self.Ts_base_object.items() if name not in still}
