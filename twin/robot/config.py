"""Settings of the kinematics; imports nothing heavy."""

import math
from dataclasses import dataclass

from bridge.errors import refuse_outside


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
    """Other starts tried after the warm start fails: random ones, or ten times as many of the
    nearest known postures; 0: none."""
    seed: int = 0
    """Seed of the random starts."""

    def __post_init__(self) -> None:
        """Refuse tolerances within which everything, or nothing, would count as reached."""
        refuse_outside(
            self,
            {
                "position_tolerance_m": (0, 0.1),
                "rotation_tolerance_rad": (0, math.pi),
                "max_iterations": (1, 100_000),
                "restarts": (0, 100_000),
                "seed": (0, 2**63),
            },
        )
