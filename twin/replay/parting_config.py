"""From which size on two tellings of one execution differ; imports nothing heavy."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class PartingConfig:
    """Limits beyond which planned, executed and recorded are apart."""

    tool_m: float = 0.01
    """Tool position, after the lag between the two is taken out [m]."""
    tool_rad: float = 0.05
    """Tool rotation [rad]."""
    width_m: float = 0.004
    """Width of the gripper [m]."""
    object_m: float = 0.02
    """Position of an object; the recorded one is localised to a few millimetres [m]."""
    contact_s: float = 0.25
    """When fingers begin or cease to touch an object [s]."""
