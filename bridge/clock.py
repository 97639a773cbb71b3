"""Time as integer nanoseconds, and a wall clock that never runs backwards."""

import time

NS_PER_S = 1_000_000_000


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

    def __init__(self) -> None:
        """Anchor the monotonic clock to the wall clock once."""
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return nanoseconds since the Unix epoch."""
        return self._offset_ns + time.monotonic_ns()
