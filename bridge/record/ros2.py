"""Records a ROS 2 robot that speaks rmw_zenoh: who is there, and what was said before we came.

Messages themselves arrive like any others. What is added here: which publishers are there, and the
last messages of transient-local ones (``/tf_static``, ``/robot_description``, maps).
"""

import threading
from concurrent.futures import ThreadPoolExecutor

from bridge.record.recorder import Recorder
from bridge.wire import rmw
from bridge.wire.session import WireSample, WireSession

HISTORY_TIMEOUT_S = 2.0
MAX_ENDPOINTS = 10_000


class Ros2Graph:
    """The ROS 2 publishers on the network, followed from their liveliness tokens until ``close``.

    With the last one of a topic go that topic's latched messages.
    """

    def __init__(self, session: WireSession, recorder: Recorder) -> None:
        """Begin to follow.

        Subscribe to the topics first: what is published meanwhile then arrives twice rather than
        not at all, and the second copy is left out or counted as repeated.
        """
        self._session = session
        self._recorder = recorder
        self._publishers: dict[str, str] = {}
        self._lock = threading.Lock()
        self._fetcher = ThreadPoolExecutor(1, thread_name_prefix="ros2 history")
        self._watching = session.watch_alive(rmw.TOKENS, self._on_token)

    def close(self) -> None:
        """Stop watching."""
        self._watching.close()
        self._fetcher.shutdown(cancel_futures=True)

    def _on_token(self, key: str, alive: bool) -> None:
        """Note who came or went, on the network thread; nothing here may wait."""
        endpoint = rmw.parse_token(key)
        if endpoint is None:
            return
        topic = endpoint.topic
        with self._lock:
            was_there = self._publishers.pop(key, None) is not None
            if alive and len(self._publishers) < MAX_ENDPOINTS:
                self._publishers[key] = topic
            is_last = topic not in self._publishers.values()
        if alive:
            if endpoint.transient_local:
                self._recorder.input_queue.latched.declare(topic)
                self._fetcher.submit(self._fetch_history, endpoint)
            self._recorder.presence.publisher(topic, is_there=True)
        elif was_there and is_last:
            self._recorder.presence.publisher(topic, is_there=False)
            self._recorder.forget(topic)

    def _fetch_history(self, endpoint: rmw.RosPublisher) -> None:
        """Hand over what the publisher sent before we listened, and nothing twice."""
        # The cache of an AdvancedPublisher, and that of rmw_zenoh's first releases.
        caches = (f"{endpoint.key}/@adv/**", f"{endpoint.session}/{endpoint.key}")
        live: set[tuple[object, ...]] = set()
        listening = self._session.subscribe(endpoint.key, lambda each: live.add(_identity(each)))
        try:
            found = [
                sample
                for cache in caches
                for sample in self._session.query_all(cache, timeout_s=HISTORY_TIMEOUT_S)
            ]
        finally:
            listening.close()
        for sample in found:
            if _identity(sample) not in live:
                live.add(_identity(sample))
                self._recorder.receive(sample)


def _identity(sample: WireSample) -> tuple[object, ...]:
    if sample.sequence is None:
        return (sample.data,)
    return (sample.source_gid, sample.sequence)
