"""A laboratory that hides nothing."""

import numpy as np

from bridge.sources.standin.cell_file import ARM_JOINTS, CellFile, HiddenParameters


def nominal_hidden(cell: CellFile) -> HiddenParameters:
    """Return a laboratory without errors, in the middle of every range."""
    uniform = {key: (low + high) / 2 for key, (low, high) in cell.uniform.items()}
    return HiddenParameters(
        joint_offset_rad=np.zeros(len(ARM_JOINTS)),
        camera_errors={camera_id: np.eye(4) for camera_id in cell.cameras},
        deviations=None,
        **uniform,
    )


def small_transform(
    shift_m: Float[np.ndarray, "3"], turn_rad: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Build a transform from a translation and a rotation vector [rad].

    Args:
        turn_rad: Axis of the rotation times its angle; zeros for none.
    """
    angle = float(np.linalg.norm(turn_rad))
    axis = turn_rad / angle if angle > 0 else np.array([1.0, 0.0, 0.0])
    q = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
    return se3.transform_from(q, shift_m)
