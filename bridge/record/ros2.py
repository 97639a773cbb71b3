"""Records a ROS 2 robot that speaks rmw_zenoh: who is there, and what was said before we came.

Messages themselves arrive like any others. What is added here: the list of endpoints, the last
messages of transient-local publishers (``/tf_static``, ``/robot_description``, maps), and what a
person should know: types nobody can decode, definitions that differ, publishers that left.
"""

import contextlib
import queue
import threading
from pathlib import Path

from bridge.errors import GstError, MissingDependencyError
from bridge.record.recorder import Recorder
from bridge.wire import keys, rmw
from bridge.wire.rmw import is_known_definition, type_hash_of
from bridge.wire.session import WireSample, WireSession

HISTORY_TIMEOUT_S = 2.0
MAX_ENDPOINTS = 10_000
MAX_WARNINGS = 1_000


class Ros2Graph:
    """The ROS 2 publishers on the network, followed from their liveliness tokens until ``close``.

    With the last one of a topic go that topic's latched messages.
    """

    def __init__(
        self, session: WireSession, recorder: Recorder, msg_folder: Path | None = None
    ) -> None:
        """Begin to follow.

        Subscribe to the topics first: what is published meanwhile then arrives twice rather than
        not at all, and the second copy is left out or counted as repeated.
        """
        self._session = session
        self._recorder = recorder
        self._msg_folder = msg_folder
        self._publishers: dict[str, str] = {}
        self._warnings: dict[str, None] = {}
        self._lock = threading.Lock()
        self._arrived: queue.SimpleQueue[rmw.RosPublisher | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="ros2 history", daemon=True)
        self._thread.start()
        self._watching = session.watch_alive(rmw.TOKENS, self._on_token)

    def warnings(self) -> list[str]:
        """What a person should know, oldest first, each once."""
        with self._lock:
            return list(self._warnings)

    def close(self) -> None:
        """Stop watching."""
        self._watching.close()
        self._arrived.put(None)
        self._thread.join(timeout=2 * HISTORY_TIMEOUT_S + 1.0)

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
                self._recorder.declare_latched(topic)
            self._recorder.presence.publisher(topic, is_there=True)
            self._arrived.put(endpoint)
        elif was_there:
            self._warn(f"{topic}: the publisher in {endpoint.node} left")
            if is_last:
                self._recorder.presence.publisher(topic, is_there=False)
                self._recorder.forget(topic)

    def _warn(self, text: str) -> None:
        with self._lock:
            if len(self._warnings) < MAX_WARNINGS:
                self._warnings[text] = None

    def _work(self) -> None:
        while (endpoint := self._arrived.get()) is not None:
            if endpoint.transient_local:
                with contextlib.suppress(GstError):  # the session is closing, or the key is no key
                    self._fetch_history(endpoint)
            self._check_type(endpoint)

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

    def _check_type(self, endpoint: rmw.RosPublisher) -> None:
        name, type_hash = endpoint.type_name, endpoint.type_hash
        try:
            newest = type_hash_of(name, folder=self._msg_folder)
            if newest is None:
                self._warn(
                    f"{endpoint.topic}: type {name} is not known here; its messages are kept "
                    "under this name, without a definition"
                )
            elif type_hash != keys.NO_HASH and not is_known_definition(
                name, type_hash, folder=self._msg_folder
            ):
                self._warn(
                    f"{endpoint.topic}: {endpoint.node} was built with another definition of "
                    f"{name} ({type_hash}) than any known here ({newest})"
                )
        except MissingDependencyError as error:
            self._warn(str(error))


def _identity(sample: WireSample) -> tuple[object, ...]:
    if sample.sequence is None:
        return (sample.data,)
    return (sample.source_gid, sample.sequence)
