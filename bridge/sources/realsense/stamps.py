"""When was a frame taken, in this host's time?"""

from typing import Any

from bridge.sources.host_clock import HostClock
from bridge.sources.realsense.library import rs

US_PER_MS, NS_PER_US = 1000, 1000
COUNTER_WRAPS_NS = 2**32 * 1_000
"""The camera counts microseconds in 32 bits: 71.6 minutes."""


class FrameStamps:
    """Stamps of one open camera.

    With global time (librealsense relates the camera's clock to the host's) and system time the
    library's stamp is the host's time already; otherwise the camera's own counter is mapped by
    the shortest way its frames took. Colour and depth share one offset, as they share the clock:
    what lies between them is the camera's to say, not the USB bus's.
    """

    def __init__(self) -> None:
        """Start without knowing the offset."""
        self._clock = HostClock(wraps_ns=COUNTER_WRAPS_NS)

    def stamp_ns(self, frame: Any, received_ns: int) -> int | None:
        """Return when a frame was taken [ns], or None while that cannot be said yet.

        Args:
            frame: ``rs.frame``.
            received_ns: When it arrived, by the host's clock.
        """
        # A double holds today's time in microseconds exactly, in nanoseconds not.
        device_ns: int = round(frame.get_timestamp() * US_PER_MS) * NS_PER_US
        if frame.get_frame_timestamp_domain() != rs.timestamp_domain.hardware_clock:
            return device_ns
        try:
            return self._clock.map(device_ns, received_ns)
        except ValueError:  # the camera was reset without our noticing: find the offset again
            self._clock = HostClock(wraps_ns=COUNTER_WRAPS_NS)
            return None
