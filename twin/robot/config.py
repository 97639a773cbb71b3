"""Settings of the kinematics; imports nothing heavy."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class IkConfig:
    """When a pose counts as reached (errata resolution 9)."""

    position_tolerance_m: float = 0.0005
    """Largest distance between the wanted and the reached tool centre point [m]."""
    rotation_tolerance_rad: float = 0.0017453292519943296
    """Largest angle between the wanted and the reached orientation: 0.1 degree [rad]."""
    max_iterations: int = 60
    """Iterations of one Levenberg-Marquardt descent."""
    restarts: int = 20
    """Other starts tried after the warm start fails, ten times as many of arms without a closed
    form; 0: none."""
