"""Notices publishers that left, so that nothing they said is repeated in later episodes.

A source of ours declares ``<prefix>/alive``; with it go the latched messages under ``/<prefix>/``.
A ROS 2 publisher has a token; with the last one of a topic go that topic's latched messages.
What a source without either has said is remembered until the recorder ends.
"""

import threading

from bridge.record.recorder import Recorder
from bridge.wire import rmw
from bridge.wire.session import Subscriber, WireSession

ALIVE = "/alive"


class Departures:
    """Watches liveliness tokens and tells the recorder what to forget."""

    def __init__(self, session: WireSession, recorder: Recorder) -> None:
        """Begin to watch."""
        self._recorder = recorder
        self._lock = threading.Lock()
        self._tokens: dict[str, str] = {}
        self._watching: list[Subscriber] = [
            session.watch_alive(f"**{ALIVE}", self._on_source),
            session.watch_alive(rmw.TOKENS, self._on_ros),
        ]

    def close(self) -> None:
        """Stop watching."""
        for subscriber in self._watching:
            subscriber.close()

    def _on_source(self, key: str, alive: bool) -> None:
        if not alive and not key.startswith("rec/"):
            self._recorder.forget(f"/{key.removesuffix(ALIVE)}/")

    def _on_ros(self, key: str, alive: bool) -> None:
        endpoint = rmw.parse_token(key)
        if endpoint is None or endpoint.kind is not rmw.EntityKind.PUBLISHER:
            return
        with self._lock:
            if alive:
                self._tokens[key] = endpoint.topic
                return
            was_there = self._tokens.pop(key, None) is not None
            is_last = endpoint.topic not in self._tokens.values()
        if was_there and is_last:
            self._recorder.forget(endpoint.topic)
