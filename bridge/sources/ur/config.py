"""What is read from a UR arm, and how it is named. Imports nothing heavy."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bridge.errors import UsageError, refuse_outside
from bridge.sources.names import refuse_bad_name
from bridge.sources.ur.gripper import Gripper, parse_signal

RTDE_PORT = 30004


@dataclass(frozen=True, kw_only=True)
class UrConfig:
    """What is read from the arm, and how it is named."""

    cell: str = "cell"
    """Name of the cell in topics: /CELL/joint_states."""
    rate_hz: float | None = None
    """Samples per second; without it the controller's own (e-Series 500, CB3 125)."""
    port: int = RTDE_PORT
    """The controller's RTDE port."""
    gripper: str = "none"
    """Where the gripper's opening is read: none, digital_in:N, digital_out:N, analog_in:N,
    tool_analog_in:N, double_register:N or int_register:N."""
    gripper_open_value: float = 0.0
    """The signal when open: 0 or 1, volts (or amperes), or the register's value."""
    gripper_closed_value: float = 1.0
    """The signal when closed."""
    gripper_open_m: float = 0.085
    """Distance between the fingers when open [m]."""
    gripper_closed_m: float = 0.0
    """Distance between the fingers when closed [m]."""
    robot: Literal["ur5_parallel_gripper", "ur5", "none"] = "ur5_parallel_gripper"
    """URDF to publish; none publishes none."""
    urdf: Path | None = None
    """URDF file of your arm, instead of --robot."""

    def __post_init__(self) -> None:
        """Refuse what no controller can send."""
        refuse_bad_name("cell", self.cell)
        refuse_outside(self, {"rate_hz": (1, 500), "port": (1, 65535)})
        refuse_outside(self, dict.fromkeys(("gripper_open_m", "gripper_closed_m"), (0, 1)))
        if self.gripper != "none":
            parse_signal(self.gripper)
        if self.gripper_open_value == self.gripper_closed_value:
            raise UsageError(
                f"--gripper-open-value and --gripper-closed-value are both "
                f"{self.gripper_open_value:g}; they tell an open gripper from a closed one."
            )

    def make_gripper(self) -> Gripper | None:
        """The gripper's mapping, or None."""
        if self.gripper == "none":
            return None
        return Gripper(
            signal=parse_signal(self.gripper),
            open_value=self.gripper_open_value,
            closed_value=self.gripper_closed_value,
            open_m=self.gripper_open_m,
            closed_m=self.gripper_closed_m,
        )
