"""The stop of an arm that is pressed: one rule for the stand-in cell and for the twin."""

PRESSED_NS = 40_000_000
"""Pressed beyond its limit for so long the arm stops by itself; a knock is shorter."""


class PressedStop:
    """Watches the force on an arm."""

    def __init__(self, limit_N: float | None) -> None:
        """Nothing presses yet; without a limit it never stops."""
        self._limit_N, self._pressed_ns = limit_N, 0

    def found(self, force_N: float, lasted_ns: int) -> str:
        """What stops the arm after a force that lasted so long; empty: nothing does."""
        if self._limit_N is None or force_N <= self._limit_N:
            self._pressed_ns = 0
            return ""
        self._pressed_ns += lasted_ns
        if self._pressed_ns < PRESSED_NS:
            return ""
        return f"the arm is pressed with {force_N:.0f} N, the limit is {self._limit_N:g} N"
