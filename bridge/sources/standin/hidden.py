"""What the cell keeps to itself: drawn from a seed, published under ``/standin/truth/`` only."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.sources.standin.cell_file import CellFile
from bridge.task.robot import ARM_JOINTS

HIDDEN_STREAM = 101
"""Keeps the draw of the hidden parameters apart from every other draw of the same seed."""


@dataclass(frozen=True, kw_only=True)
class HiddenParameters:
    """The true laboratory, as far as it differs from what it publishes of itself."""

    finger_friction: float
    object_friction: float
    mass_scale: float
    grip_N: float
    latency_s: float
    depth_scale: float
    depth_offset_m: float
    image_gain: float
    joint_offset_rad: Float[np.ndarray, "6"]
    """Encoder reading minus true angle."""
    camera_errors: dict[str, Float[np.ndarray, "4 4"]]
    """Per camera ``T_nominal_true``: the true camera seen from where it is believed to be."""
    stiffness_scale: float | None = None
    """Times the nominal stiffness of soft objects; None in a cell that has none."""

    def to_record(self) -> dict[str, Any]:
        """Return plain numbers for the truth topic."""
        record = asdict(self)
        if self.stiffness_scale is None:
            del record["stiffness_scale"]
        record["joint_offset_rad"] = self.joint_offset_rad.tolist()
        record["camera_errors"] = {
            key: T.round(9).tolist() for key, T in self.camera_errors.items()
        }
        return record


def draw_hidden(cell: CellFile, seed: int) -> HiddenParameters:
    """Draw one laboratory; the same cell file and seed give the same one."""
    rng = np.random.default_rng([HIDDEN_STREAM, seed])
    uniform = {key: float(rng.uniform(*cell.uniform[key])) for key in sorted(cell.uniform)}
    errors = {}
    for camera_id in sorted(cell.cameras):
        shift = rng.normal(0.0, cell.normal[f"{camera_id}_camera_m"], 3)
        turn = rng.normal(0.0, cell.normal[f"{camera_id}_camera_rad"], 3)
        errors[camera_id] = small_transform(shift, turn)
    offset = rng.normal(0.0, cell.normal["joint_offset_rad"], len(ARM_JOINTS))
    return HiddenParameters(joint_offset_rad=offset, camera_errors=errors, **uniform)


def nominal_hidden(cell: CellFile) -> HiddenParameters:
    """Return a laboratory without errors, in the middle of every range; for tests."""
    uniform = {key: (low + high) / 2 for key, (low, high) in cell.uniform.items()}
    return HiddenParameters(
        joint_offset_rad=np.zeros(len(ARM_JOINTS)),
        camera_errors={camera_id: np.eye(4) for camera_id in cell.cameras},
        **uniform,
    )


def small_transform(
    shift_m: Float[np.ndarray, "3"], turn_rad: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Build a transform from a translation and a rotation vector [rad]."""
    angle = float(np.linalg.norm(turn_rad))
    axis = turn_rad / angle if angle > 0 else np.array([1.0, 0.0, 0.0])
    q = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
    return se3.transform_from(q, shift_m)
