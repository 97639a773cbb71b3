"""Settings of the physics; imports nothing heavy."""

from dataclasses import dataclass


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
    finger_speed_m_s: float = 0.1
    """Largest speed of each finger."""
    object_friction: float = 0.8
    """Sliding friction coefficient of objects; PyBullet multiplies both partners'."""
    finger_friction: float = 1.0
    """Sliding friction coefficient of the finger pads."""
    surface_friction: float = 0.8
    """Sliding friction coefficient of table and containers."""
    gravity_m_s2: float = 9.81
    """Downward acceleration."""
    soft_substeps: int = 10
    """Substeps of soft bodies within each physics step; 10 are 2400 a second."""
    soft_stiffness_scale: float = 1.0
    """Factor on Young's modulus of all soft bodies."""
