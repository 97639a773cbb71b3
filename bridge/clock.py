"""Time as integer nanoseconds, and a wall clock that never runs backwards."""

import time
from collections.abc import Callable
from typing import Literal

NS_PER_S = 1_000_000_000
STEP_NS = 50_000_000
"""A system clock that moves this far at once was set, not trimmed."""


ClockChoice = Literal["recorded", "corrected"]
"""Stamps as each source's own clock made them, or in the time of the recorder's clock."""


def ns_from_s(seconds: float) -> int:
    """Turn seconds into integer nanoseconds, rounding to nearest."""
    return round(seconds * NS_PER_S)


def s_from_ns(nanoseconds: int) -> float:
    """Turn integer nanoseconds into seconds."""
    return nanoseconds / NS_PER_S


def split_ns(stamp_ns: int) -> tuple[int, int]:
    """Split a stamp into the (sec, nanosec) pair of ``builtin_interfaces/Time``."""
    return divmod(stamp_ns, NS_PER_S)


def join_ns(sec: int, nanosec: int) -> int:
    """Join the (sec, nanosec) pair of ``builtin_interfaces/Time``."""
    return sec * NS_PER_S + nanosec


class AnchoredClock:
    """Wall time at start plus elapsed monotonic time.

    A step of the system clock (NTP, a person) cannot reorder messages stamped with it.
    """

    def __init__(
        self,
        *,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Anchor the monotonic clock to the wall clock once."""
        self._monotonic_ns = monotonic_ns
        self._offset_ns = wall_ns() - monotonic_ns()

    def now_ns(self) -> int:
        """Return nanoseconds since the Unix epoch."""
        return self._offset_ns + self._monotonic_ns()


class StepWatch:
    """Notices steps of the system clock, by comparing it with one that has none."""

    def __init__(
        self, now_ns: Callable[[], int], *, wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        """Remember how far the clocks are apart now."""
        self._now_ns = now_ns
        self._wall_ns = wall_ns
        self._apart_ns = wall_ns() - now_ns()

    def step_ns(self) -> int:
        """Return the step since the last call [ns], or 0 where there was none.

        Forward is positive. Trimming (NTP slewing) stays far below ``STEP_NS`` from call to call.
        """
        before_ns, wall_ns = self._now_ns(), self._wall_ns()
        if self._now_ns() - before_ns > STEP_NS // 10:  # something came between the two
            return 0
        moved_ns, self._apart_ns = wall_ns - before_ns - self._apart_ns, wall_ns - before_ns
        return moved_ns if abs(moved_ns) > STEP_NS else 0
