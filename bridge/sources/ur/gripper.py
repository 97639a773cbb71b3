"""The opening of a gripper, read from the controller's inputs, outputs or registers.

RTDE does not know grippers: it knows the signals they are wired to, and registers that the robot
program writes. ``docs/recording.md`` says which signal suits which gripper.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from bridge.errors import UsageError

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
    open_value: float
    closed_value: float
    open_m: float
    closed_m: float

    def width_m(self, values: Mapping[str, Value]) -> float:
        """Distance between the fingers, within its ends [m]."""
        span = self.closed_value - self.open_value
        closed = (self.signal.read(values) - self.open_value) / span
        return self.open_m + min(max(closed, 0.0), 1.0) * (self.closed_m - self.open_m)


def parse_signal(text: str) -> Signal:
    """Read ``digital_in:16`` and the like.

    Raises:
        UsageError: When there is no such signal.
    """
    match = _SIGNAL.fullmatch(text)
    kind, number = (match[1], int(match[2])) if match else ("", 0)
    variable, count = _VARIABLES.get(kind, ("", 0))
    if number >= count:
        listed = ", ".join(f"{name}:0..{n - 1}" for name, (_, n) in _VARIABLES.items())
        raise UsageError(f"--gripper {text} is no signal of a UR controller. Use none or {listed}.")
    bit = number if kind.startswith("digital") else None
    return Signal(variable=variable.format(number), bit=bit)
