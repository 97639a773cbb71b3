"""Gradients of the native code one by one, as tests compare them; a fit uses whole steps."""

from types import SimpleNamespace

import numpy as np

from twin.scene.raster.rasteriser import NAMES, FitSession, Rasteriser, StepReport


def pull_back(
    rasteriser: Rasteriser, planes: np.ndarray, plane_gradients: np.ndarray
) -> SimpleNamespace:
    """Carry a gradient on the planes of the last ``draw_planes`` back to its cloud."""
    *rows, pose = rasteriser._native.pull(planes, plane_gradients)
    return SimpleNamespace(**dict(zip(NAMES, rows, strict=True)), T_camera_base=pose)


def gradient_of(session: FitSession, report: StepReport) -> SimpleNamespace:
    """A copy of the last step's gradient; ``report`` is that step's."""
    named = dict(zip(NAMES, session._native.gradients(), strict=True))
    return SimpleNamespace(**named, T_camera_base=report.T_camera_base)
