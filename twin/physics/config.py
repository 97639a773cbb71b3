"""Settings of the physics; imports nothing heavy."""

from dataclasses import dataclass
from importlib import util
from typing import Literal

from bridge.errors import MissingDependencyError, refuse_outside

Engine = Literal["pybullet", "mujoco"]
"""What moves rigid bodies."""
ENGINES: tuple[Engine, ...] = ("pybullet", "mujoco")

RIGID_ONLY = (
    "the engine mujoco replays rigid objects only. Soft ones take --engine pybullet, beside which "
    "they are solved by xpbd."
)


def require_engine(engine: Engine) -> None:
    """Refuse an engine that is not installed."""
    if engine == "mujoco" and util.find_spec(engine) is None:
        raise MissingDependencyError(package=engine, extra=engine, purpose=f"--engine {engine}")


FINGER_SPEED_M_S = 0.1
"""Largest speed of each finger."""


@dataclass(frozen=True, kw_only=True)
class Unseen:
    """What cameras do not show of a box; as built: full edges, the weight in the middle."""

    edge_m: float = 0.0
    """Width and depth of a step along every edge: each face is smaller than the box by twice it."""
    centre_of_mass_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the box's middle, along its axes."""


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Nominal physics; what is not measured in a cell stays at these values."""

    rate_hz: int = 240
    """Physics steps per second."""
    solver_iterations: int = 75
    """Constraint solver iterations per step. What anchored friction lets slip is no less at 100;
    at 50 it is twice as much, at 30 grasps jump by 6 mm (measured)."""
    solver_residual: float = 1e-4
    """The solver stops early below this change; PyBullet's own 1e-7 costs a third more while
    something is held (measured)."""
    grip_force_N: float = 20.0
    """Largest force of each finger; 60 N ejects a 50 g cube (measured)."""
    object_friction: float = 0.8
    """Sliding friction coefficient of objects; PyBullet multiplies both partners'."""
    finger_friction: float = 1.0
    """Sliding friction coefficient of the finger pads."""
    surface_friction: float = 0.8
    """Sliding friction coefficient of table and containers."""
    gravity_m_s2: float = 9.81
    """Downward acceleration."""

    def __post_init__(self) -> None:
        """Refuse what is no physics; samples draw from wide priors, so the limits are wide too."""
        least, most = 1e-6, 1e6
        frictions = ("object_friction", "finger_friction", "surface_friction")
        refuse_outside(
            self,
            {
                **dict.fromkeys(("rate_hz", "solver_iterations"), (1, 100_000)),
                **dict.fromkeys(frictions, (0, most)),
                "solver_residual": (0, 1),
                "grip_force_N": (least, most),
                "gravity_m_s2": (0, 1000),
            },
        )
