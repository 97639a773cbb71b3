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
