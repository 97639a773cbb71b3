"""What is read from a UR arm, and how it is named. Imports nothing heavy.

RTDE does not know grippers: it knows the inputs, outputs and registers they are wired to, and
registers that the robot program writes. ``docs/recording.md`` says which suits which gripper.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from bridge.episode.topics import refuse_bad_name
from bridge.errors import BridgeError, UsageError, refuse_outside
from bridge.robots.robot import DEFAULT_ROBOT

Value = bool | int | float | tuple[float, ...] | tuple[int, ...]
_SIGNAL = re.compile(r"([a-z_]+):(\d{1,2})")
_VARIABLES: dict[str, tuple[str, int]] = {
    "digital_in": ("actual_digital_input_bits", 18),
    "digital_out": ("actual_digital_output_bits", 18),
    "analog_in": ("standard_analog_input{}", 2),
    "tool_analog_in": ("tool_analog_input{}", 2),
    "double_register": ("output_double_register_{}", 48),
    "int_register": ("output_int_register_{}", 48),
}
"""RTDE variable and how many there are. Bits 0-7 standard, 8-15 configurable, 16-17 tool."""


@dataclass(frozen=True, kw_only=True)
class Signal:
    """One number the controller knows."""

    variable: str
    """RTDE output that holds it."""
    bit: int | None
    """Which bit of it; None: its value."""

    def read(self, values: Mapping[str, Value]) -> float:
        """Return the number: 0 or 1, volts (or amperes), or a register's value."""
        value = values[self.variable]
        if self.bit is not None:
            return float(int(value) >> self.bit & 1)  # type: ignore[arg-type]
        return float(value)  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A straight line from a signal to the distance between the fingers."""

    signal: Signal
    config: "UrConfig"

    def width_m(self, values: Mapping[str, Value]) -> float:
        """Distance between the fingers, within its ends [m]."""
        config = self.config
        span = config.gripper_closed_value - config.gripper_open_value
        closed = (self.signal.read(values) - config.gripper_open_value) / span
        reach_m = config.gripper_closed_m - config.gripper_open_m
        return config.gripper_open_m + min(max(closed, 0.0), 1.0) * reach_m


def parse_signal(text: str) -> Signal:
    """Read ``digital_in:16`` and the like."""
    match = _SIGNAL.fullmatch(text)
    kind, number = (match[1], int(match[2])) if match else ("", 0)
    variable, count = _VARIABLES.get(kind, ("", 0))
    if number >= count:
        listed = ", ".join(f"{name}:0..{n - 1}" for name, (_, n) in _VARIABLES.items())
        raise UsageError(f"--gripper {text} is no signal of a UR controller. Use none or {listed}.")
    bit = number if kind.startswith("digital") else None
    return Signal(variable=variable.format(number), bit=bit)


class ControllerError(BridgeError):
    """The controller is not there, not ready, or gone."""

    def __init__(self, *, where: str, found: str, hint: str) -> None:
        """Remember the address and what was found there."""
        super().__init__(f"{where}: {found}. {hint}")


class NotRtdeError(ControllerError):
    """What answers at the address does not speak RTDE, or broke its rules."""

    def __init__(self, *, where: str, found: str) -> None:
        """Remember the address and what was found there."""
        super().__init__(
            where=where,
            found=f"not a UR controller's RTDE interface: {found}",
            hint="Check the address, the port (30004) and Settings > Security > Services > RTDE.",
        )


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
    robot: str = DEFAULT_ROBOT
    """Robot file, by name or path (docs/robots.md): its description is published and its joint
    names are used; ur5 publishes the bare arm, none publishes no description."""

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
        return Gripper(signal=parse_signal(self.gripper), config=self)
