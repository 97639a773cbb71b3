"""Samples of a device: their time on this host's clock, their numbers, what is announced with them.

A sample cannot arrive before it was taken, so the smallest (arrival - device stamp) of a while is
the offset between the clocks plus the shortest way the samples took. Queues and stalls only make
arrivals later, and later ones do not count.
"""

import contextlib
import queue
import threading
import time
from collections import deque
from typing import Any, NamedTuple

from bridge.clock import NS_PER_S
from bridge.episode.schema import StampedMessage
from bridge.errors import GstError
from bridge.wire.qos import Qos
from bridge.wire.session import WirePublisher, WireSession

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

        Raises:
            ValueError: When the device's clock went backwards: it was started again.
        """
        device_ns += self._wrapped_ns
        last_ns = self._last_device_ns
        if last_ns is not None and device_ns < last_ns - RESTART_NS:
            if self._wraps_ns is None or last_ns - device_ns < self._wraps_ns // 2:
                raise ValueError("the device's clock went backwards")
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


MAX_GAP = 10_000_000
"""A larger step is a counter that was set anew, not a loss."""


class NumberedPublisher:
    """Sends samples of one stream; numbers left out by the device become gaps on the wire.

    The recorder enters gaps of sequence numbers in its drop log, wherever they arose.
    """

    def __init__(self, publisher: WirePublisher) -> None:
        """Take over a publisher that nobody else uses."""
        self._publisher = publisher
        self._expected: int | None = None
        self.sent = 0
        self.lost = 0

    def put(self, number: int, data: bytes, *, source_ns: int) -> int:
        """Send one sample and return how many are missing directly before it."""
        gap = 0 if self._expected is None else number - self._expected
        if not 0 < gap <= MAX_GAP:
            gap = 0
        self._expected = number + 1
        if gap:
            self._publisher.skip(gap)
            self.lost += gap
        self._publisher.put(data, source_ns=source_ns)
        self.sent += 1
        return gap


REPEAT_S = 5.0
"""Lasting facts are said again this often: a recorder started later, or again, gets them too."""


class _Entry(NamedTuple):
    message: StampedMessage
    fact: Any


class Announcer:
    """Sends events once and lasting facts (calibration, fixed transforms, the URDF) repeatedly."""

    def __init__(self, session: WireSession) -> None:
        """Start the thread."""
        self._session = session
        self._publishers: dict[str, WirePublisher] = {}
        self._facts: dict[Any, StampedMessage] = {}
        self._queue: queue.SimpleQueue[_Entry | None] = queue.SimpleQueue()
        self.failure: GstError | None = None
        self._thread = threading.Thread(target=self._work, name="announcer", daemon=True)
        self._thread.start()

    def event(self, message: StampedMessage) -> None:
        """Send once, in order."""
        self._queue.put(_Entry(message, None))

    def fact(self, key: object, message: StampedMessage) -> None:
        """Send now and every few seconds, until another fact takes the key."""
        self._queue.put(_Entry(message, key))

    def close(self) -> None:
        """Send what waits, for at most five seconds, then stop."""
        self._queue.put(None)
        self._thread.join(timeout=REPEAT_S)

    def _work(self) -> None:
        repeat_s = time.monotonic() + REPEAT_S
        try:
            while True:
                with contextlib.suppress(queue.Empty):
                    entry = self._queue.get(timeout=max(0.0, repeat_s - time.monotonic()))
                    if entry is None:
                        return
                    if entry.fact is not None:
                        self._facts[entry.fact] = entry.message
                    self._put(entry.message, entry.message.stamp_ns)
                if time.monotonic() >= repeat_s:
                    for message in self._facts.values():
                        self._put(message, self._session.now_ns())
                    repeat_s = time.monotonic() + REPEAT_S
        except GstError as error:
            self.failure = error

    def _put(self, message: StampedMessage, source_ns: int) -> None:
        publisher = self._publishers.get(message.topic)
        if publisher is None:
            publisher = self._session.publisher(message.topic, message.type_name, qos=Qos.RELIABLE)
            self._publishers[message.topic] = publisher
        publisher.put(message.data, source_ns=source_ns)
