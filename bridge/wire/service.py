"""Answering requests on one key."""

import contextlib
import queue
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

from bridge.errors import GstError
from bridge.wire.library import zenoh

MAX_WAITING = 32
"""Requests that wait for one service; each may hold a whole plan."""
CLOSE_S = 5.0
"""How long a request in work may take when the service stops."""


class Service:
    """Answers requests on one key on its own threads, as many side by side as there are."""

    def __init__(
        self,
        key: str,
        handler: Callable[[bytes], bytes],
        max_waiting: int,
        side_by_side: int = 1,
    ) -> None:
        """Use ``WireSession.serve``."""
        self._key = key
        self._handler = handler
        self._max_waiting = max_waiting
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._inner: Any = None
        self._threads = [
            threading.Thread(target=self._work, name=f"serve {key}", daemon=True)
            for _ in range(side_by_side)
        ]
        for thread in self._threads:
            thread.start()

    def start(self, inner: Any) -> None:
        """Keep the queryable that feeds this service."""
        self._inner = inner

    def take(self, query: Any) -> None:
        """Queue a request, on the network thread; one too many is refused at once."""
        if self._requests.qsize() < self._max_waiting:
            self._requests.put(query)
            return
        with query, contextlib.suppress(zenoh.ZError):
            query.reply_err(
                f"busy: {self._max_waiting} requests on {self._key} wait already. "
                "Ask again later, or start another one under its own name."
            )

    def _work(self) -> None:
        while (query := self._requests.get()) is not None:
            with query, contextlib.suppress(zenoh.ZError):  # the asker may be gone
                payload = b"" if query.payload is None else query.payload.to_bytes()
                try:
                    query.reply(self._key, self._handler(payload))
                except GstError as error:
                    query.reply_err(str(error))
                except Exception as error:  # noqa: BLE001  # a bug in one answer, not the end
                    traceback.print_exc()
                    query.reply_err(f"internal error: {type(error).__name__}: {error}")

    def close(self) -> None:
        """Stop answering; a request in work is finished first."""
        if self._inner is not None:
            with contextlib.suppress(zenoh.ZError):
                self._inner.undeclare()
        for _ in self._threads:
            self._requests.put(None)
        ends_s = time.monotonic() + CLOSE_S
        for thread in self._threads:
            thread.join(timeout=max(0.0, ends_s - time.monotonic()))
