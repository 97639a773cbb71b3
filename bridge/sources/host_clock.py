"""When did a device with a clock of its own take a sample, in this host's time?

A sample cannot arrive before it was taken, so the smallest (arrival - device stamp) of a while is
the offset between the clocks plus the shortest way the samples took. Queues and stalls only make
arrivals later, and later ones do not count.
"""

from collections import deque

from bridge.clock import NS_PER_S

BUCKET_NS = 2 * NS_PER_S
NUM_BUCKETS = 5
"""The minimum is taken over ten seconds: long enough to meet a quick arrival, short enough that
oscillators 50 ppm apart drift by half a millisecond only."""
SETTLE_NS = NS_PER_S // 2
MAX_SLEW = 0.05
"""The offset moves by at most this fraction of the time that passes, so stamps keep their order
and distances between samples stay within five percent of the device's."""
RESTART_NS = NS_PER_S
"""Samples of two streams of a device may come this much out of order; beyond, it was restarted."""


class HostClock:
    """Maps the stamps of one device to the host's clock; one per connection."""

    def __init__(self, *, wraps_ns: int | None = None) -> None:
        """Start without knowing the offset.

        Args:
            wraps_ns: The device counts from 0 again after this long [ns]; None: never.
        """
        self._wraps_ns = wraps_ns
        self._wrapped_ns = 0
        self._minima: deque[list[int]] = deque(maxlen=NUM_BUCKETS)
        self._first_received_ns: int | None = None
        self._offset_ns: float | None = None
        self._last_device_ns: int | None = None

    def map(self, device_ns: int, received_ns: int) -> int | None:
        """Return the host time of a sample, or None while the offset is still being found.

        Args:
            device_ns: The device's stamp.
            received_ns: When it arrived here, by the host's clock.

        Raises:
            ValueError: When the device's clock went backwards: it was started again.
        """
        device_ns += self._wrapped_ns
        last_ns = self._last_device_ns
        if last_ns is not None and device_ns < last_ns - RESTART_NS:
            if self._wraps_ns is None or last_ns - device_ns < self._wraps_ns // 2:
                message = "the device's clock went backwards"
                raise ValueError(message)
            self._wrapped_ns += self._wraps_ns
            device_ns += self._wraps_ns
        self._last_device_ns = device_ns if last_ns is None else max(device_ns, last_ns)
        target_ns = self._shortest(received_ns - device_ns, received_ns)
        if self._first_received_ns is None:
            self._first_received_ns = received_ns
        if self._offset_ns is None:
            if received_ns - self._first_received_ns < SETTLE_NS:
                return None
            self._offset_ns = target_ns
        elif last_ns is not None:
            most = MAX_SLEW * max(0, device_ns - last_ns)
            self._offset_ns += min(max(target_ns - self._offset_ns, -most), most)
        return device_ns + round(self._offset_ns)

    def _shortest(self, difference_ns: int, received_ns: int) -> int:
        if not self._minima or received_ns - self._minima[-1][0] >= BUCKET_NS:
            self._minima.append([received_ns, difference_ns])
        else:
            self._minima[-1][1] = min(self._minima[-1][1], difference_ns)
        return min(smallest for _, smallest in self._minima)
