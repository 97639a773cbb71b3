"""What an arm was told and what it pushes, where a recording has poses and no plan.

A recording of somebody else may hold poses of a tool and of boxes, and neither joints nor a plan.
The metadata record ``scripted_motion`` of its episode says the rest: which robot, which of its
links carries the tool, the schedule that the joints were given, and the boxes on the table.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np
from jaxtyping import Float

from bridge.errors import InvalidRecordError
from bridge.task.record import made_of

RECORD_NAME = "scripted_motion"
_VERSION = 1
Positive = Annotated[float, msgspec.Meta(gt=0, lt=1e9)]


@dataclass(frozen=True, kw_only=True)
class PushedBox:
    """A box that stands on the table."""

    size_m: tuple[Positive, Positive, Positive]
    mass_kg: Positive


@dataclass(frozen=True, kw_only=True)
class JointTarget:
    """Where joints are told to go from some time on; the others keep their targets."""

    t_s: float
    joints_rad: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class ScriptedMotion:
    """Robot, schedule and boxes. All joints are zero at the start."""

    robot: str
    """Path of the URDF in the run folder; its meshes lie beside it."""
    hand_link: str
    """Link that carries the tool; it and all links behind it may touch boxes."""
    joints: tuple[str, ...]
    base_m: tuple[float, float, float]
    """Where the root of the URDF stands, its axes along those of the world."""
    targets: tuple[JointTarget, ...]
    gain_hz: Positive
    """Speed that a joint is told per distance to its target."""
    limit_rad_s: Positive
    period_s: Positive
    duration_s: Positive
    boxes: Mapping[str, PushedBox] = field(default_factory=dict)
    """By object id; empty where the tool alone moves."""

    def joint_path_rad(
        self,
    ) -> tuple[Float[np.ndarray, " num_commands"], Float[np.ndarray, "num_commands num_joints"]]:
        """Follow the velocity commands without error: their times, and where the joints are then.

        Speed = clip(gain x (target - joint), +- limit), held until the next command.

        Returns:
            Times from the start [s], and joints [rad] in the order of ``joints``; linear between.
        """
        count = round(self.duration_s / self.period_s)
        times_s = np.arange(count + 1) * self.period_s
        q = np.zeros((count + 1, len(self.joints)))
        target = np.zeros(len(self.joints))
        waiting = list(self.targets)
        for index in range(count):
            while waiting and waiting[0].t_s <= times_s[index] + 1e-9:
                for name, value in waiting.pop(0).joints_rad.items():
                    target[self.joints.index(name)] = value
            speed = np.clip(self.gain_hz * (target - q[index]), -self.limit_rad_s, self.limit_rad_s)
            q[index + 1] = q[index] + speed * self.period_s
        return times_s, q

    def to_record(self) -> dict[str, str]:
        """Return the metadata record of an episode."""
        record = {"schema_version": _VERSION, **asdict(self)}
        return {name: json.dumps(value) for name, value in record.items()}

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> "ScriptedMotion":
        """Read a metadata record whose values are parsed."""
        version = record.get("schema_version")
        if version != _VERSION:
            found = f"schema version {version!r}, known is {_VERSION}"
            raise InvalidRecordError(name=RECORD_NAME, where="schema_version", found=found)
        motion = made_of(ScriptedMotion, record, name=RECORD_NAME)
        unknown = {name for item in motion.targets for name in item.joints_rad} - {*motion.joints}
        if unknown:
            found = f"{', '.join(sorted(unknown))} is none of {', '.join(motion.joints)}"
            raise InvalidRecordError(name=RECORD_NAME, where="targets", found=found)
        return motion
