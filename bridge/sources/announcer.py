"""Says what must not be lost on a thread of its own, so that samples never wait for it."""

import contextlib
import queue
import threading
import time
from typing import Any, NamedTuple

from bridge.episode.message import StampedMessage
from bridge.errors import GstError
from bridge.wire.qos import Qos
from bridge.wire.session import WirePublisher, WireSession

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
