"""Zenoh sessions: publish, subscribe, serve and ask. The only place that imports zenoh.

Callbacks run on the network thread and get a copy of the bytes at once; they must be quick.
Samples and requests of one client arrive in the order it sent them, so a request that follows
samples finds them already delivered.
"""

import contextlib
import hashlib
import queue
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from types import TracebackType
from typing import Any

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.errors import GstError
from bridge.wire import keys, publisher
from bridge.wire.config import WireConfig as WireConfig
from bridge.wire.errors import (
    BadTopicError,
    NoPeerError,
    NoReplyError,
    PortTakenError,
    RemoteError,
    WireConfigError,
    WireError,
    cause_of,
    public,
)
from bridge.wire.publisher import BYTES_PER_MB, SharedPool
from bridge.wire.publisher import WirePublisher as WirePublisher
from bridge.wire.qos import Qos
from bridge.wire.zenoh_config import zenoh, zenoh_config

MAX_WAITING = 32
"""Requests that wait for one service; each may hold a whole plan."""
CLOSE_S, UNHEARD_S = 5.0, 0.5
"""How long a request in work may take when the service stops; one that perhaps nobody hears."""


class Service:
    """Answers requests on one key on its own threads, as many side by side as there are."""

    def __init__(
        self,
        key: str,
        handler: Callable[[bytes], bytes],
        side_by_side: int,
    ) -> None:
        """Use ``WireSession.serve``."""
        self._key = key
        self._handler = handler
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
        if self._requests.qsize() < MAX_WAITING:
            self._requests.put(query)
            return
        with query, contextlib.suppress(zenoh.ZError):
            query.reply_err(
                f"busy: {MAX_WAITING} requests on {self._key} wait already. "
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


@dataclass(frozen=True, kw_only=True, slots=True)
class WireSample:
    """One message as it arrived."""

    topic: str
    type_name: str
    """"" when the publisher did not say."""
    message_encoding: str
    """cdr, json or ""."""
    type_hash: str = ""
    """RIHS01 hash of the ROS 2 definition the publisher was built with; "" when it did not say."""
    data: bytes
    source_ns: int | None
    """When the publisher says it made the message."""
    sequence: int | None
    """Counts the publisher's messages; None when they are not numbered."""
    source_gid: bytes | None
    """16 bytes that no other publisher has."""
    received_ns: int
    oversize_bytes: int = 0
    """Size of a payload beyond the subscription's limit; then ``data`` is empty, not a copy."""


def copy_sample(sample: Any, received_ns: int, *, max_bytes: int = sys.maxsize) -> WireSample:
    """Read a zenoh sample. Its payload is copied: a kept one would pin the sender's memory."""
    size = len(sample.payload)
    is_oversize = size > max_bytes
    named = keys.read_key(str(sample.key_expr))
    type_name, message_encoding = keys.parse_encoding(str(sample.encoding))
    raw = sample.attachment
    note = publisher.decode(None if raw is None else raw.to_bytes())
    if note is None:
        sequence, gid = _source_of(sample.source_info)
        source_ns = None
    else:
        sequence, gid, source_ns = note.sequence, note.gid, note.source_ns
    return WireSample(
        topic=named.topic,
        type_name=type_name or named.type_name,
        message_encoding=message_encoding or ("cdr" if named.type_name else ""),
        type_hash=named.type_hash,
        data=b"" if is_oversize else sample.payload.to_bytes(),
        source_ns=source_ns,
        sequence=sequence,
        source_gid=gid,
        received_ns=received_ns,
        oversize_bytes=size if is_oversize else 0,
    )


def _source_of(info: Any) -> tuple[int | None, bytes | None]:
    """Number and publisher of a sample that zenoh itself numbered (an AdvancedPublisher does)."""
    if info is None:
        return None, None
    source = info.source_id
    return int(info.source_sn), _gid(str(source.zid), int(source.eid))


@lru_cache(maxsize=4096)
def _gid(session: str, entity: int) -> bytes:
    name = f"{session}/{entity}".encode()
    return hashlib.blake2b(name, digest_size=publisher.GID_BYTES).digest()


class Subscriber:
    """A running subscription, or a token that says that somebody is there."""

    def __init__(self, inner: Any) -> None:
        """Use ``WireSession.subscribe`` or ``declare_alive``."""
        self._inner = inner

    def close(self) -> None:
        """Stop receiving, or say goodbye."""
        with contextlib.suppress(zenoh.ZError):
            self._inner.undeclare()


class WireSession:
    """A live connection; use as a context manager."""

    def __init__(self, inner: Any, *, shared_memory_mb: int = 0, config: WireConfig) -> None:
        """Use ``open_session``."""
        self._inner = inner
        self._config = config
        self.receive_errors = 0
        """Messages that could not be taken in; the numbers of their publishers show which."""
        self.last_receive_error = ""
        self._clock = AnchoredClock()
        self._services: list[Service] = []
        self._alive: list[Subscriber] = []
        self._last_words: list[tuple[Any, Callable[[bytes], bytes]]] = []
        self._publishers: list[tuple[str, WirePublisher]] = []
        self._pool = SharedPool(shared_memory_mb * BYTES_PER_MB) if shared_memory_mb else None

    @property
    def identity(self) -> str:
        """Zenoh's id of this session; no other one has it."""
        return str(self._inner.zid())

    def now_ns(self) -> int:
        """The clock that stamps ``received_ns``; it never runs backwards."""
        return self._clock.now_ns()

    def publisher(
        self,
        topic: str,
        type_name: str,
        *,
        qos: Qos = Qos.RELIABLE,  # when the network is behind; loops use ``Qos.CONTROL``
    ) -> WirePublisher:
        """Announce a topic."""
        known = schema.schema_for(type_name)
        encoding = keys.encoding_of(type_name, known.message_encoding if known else "cdr")
        control = zenoh.CongestionControl
        locality = zenoh.Locality.REMOTE if qos.is_remote else zenoh.Locality.ANY
        try:
            inner = self._inner.declare_publisher(
                keys.key_from_topic(topic),
                encoding=encoding,
                congestion_control=control.BLOCK if qos.block else control.DROP,
                priority=getattr(zenoh.Priority, qos.priority.upper()),
                allowed_destination=locality,
            )
        except zenoh.ZError as error:
            raise BadTopicError(topic=topic, found=cause_of(error)) from error
        made = WirePublisher(inner, self._pool if qos.shared_memory else None)
        self._publishers.append((topic, made))
        return made

    def sent(self) -> dict[str, dict[str, int]]:
        """By topic and publisher id in hex, the messages so far, those that zenoh dropped too."""
        counts: dict[str, dict[str, int]] = {}
        for topic, made in list(self._publishers):
            counts.setdefault(topic, {})[made.gid.hex()] = made.sent
        return counts

    def subscribe(
        self,
        key_expression: str,
        callback: Callable[[WireSample], None],
        *,
        max_bytes: int = sys.maxsize,
    ) -> Subscriber:
        """Receive what matches, for example ``standin/**``, on the network thread."""

        def on_sample(sample: Any) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            try:
                callback(copy_sample(sample, self._clock.now_ns(), max_bytes=max_bytes))
            except BaseException as error:  # noqa: BLE001  # let out, it ends this link's thread
                self.receive_errors += 1
                self.last_receive_error = f"{type(error).__name__}: {error}"

        handler = zenoh.handlers.Callback(on_sample, indirect=False)
        with _naming(WireConfigError, f"cannot subscribe to {key_expression!r}"):
            return Subscriber(self._inner.declare_subscriber(key_expression, handler))

    def follow(self, topic: str, callback: Callable[[WireSample], None]) -> None:
        """Receive a topic, or all below ``/**``, ROS 2 nodes' too: what they keep comes first."""
        ros = f"*{topic}" if topic.endswith("**") else f"*{topic}/*/*"
        for key in (topic[1:], ros):
            self.subscribe(key, callback)
        for sample in self.query_all(f"{ros}/@adv/**", timeout_s=2.0):
            callback(sample)

    def open_loopback(self) -> "WireSession":
        """Open a client of the endpoint this session listens on, else of one it connects to.

        What it publishes reaches this session through the network, as everybody else's does.
        """
        endpoints = self._config.listen or self._config.connect
        own = replace(
            self._config, mode="client", connect=endpoints[:1], listen=(), shared_memory_mb=0
        )
        return open_session(own)

    def serve(
        self,
        key: str,
        handler: Callable[[bytes], bytes],
        *,
        side_by_side: int = 1,
    ) -> Service:
        """Answer requests on a key; a ``GstError`` of the handler goes back as the answer."""
        service = Service(key, handler, side_by_side)
        callback = zenoh.handlers.Callback(service.take, indirect=False)
        try:
            service.start(self._inner.declare_queryable(key, callback))
        except zenoh.ZError as error:
            service.close()
            raise WireConfigError(f"cannot answer on {key!r}: {cause_of(error)}.") from error
        self._services.append(service)
        return service

    def say_last(self, key: str, words: Callable[[bytes], bytes]) -> None:
        """Ask on a key once more before the session closes, and wait for who listens there.

        The request comes behind all that was published: what was heard of it by then was all.
        """
        self._last_words.append((self._inner.declare_querier(key), words))

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Ask and wait for the answer."""
        with _naming(WireError, f"cannot ask {key}"):
            replies = list(self._inner.get(key, payload=payload, timeout=timeout_s))
        refusal = None
        for reply in replies:
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
            refusal = reply.err.payload.to_bytes().decode(errors="replace")
        if refusal is None or refusal == "Timeout":
            raise NoReplyError(key=key, timeout_s=timeout_s)
        raise RemoteError(refusal)

    def query_all(
        self, key_expression: str, *, timeout_s: float, max_mb: int = 64, is_last: bool = False
    ) -> list[WireSample]:
        """Ask everybody and return every good answer, in the order they came.

        Used for what caches keep: the last messages of a topic whose publisher spoke before we
        listened. Whoever has not answered in time is left out, and so is what does not fit
        into ``max_mb`` [MB], for nobody knows what a cache holds. ``is_last``: no answer overtakes
        what its sender has published before.
        """
        answers: list[WireSample] = []
        left = max_mb * BYTES_PER_MB
        with _naming(WireError, f"cannot ask {key_expression}"):
            replies = self._inner.get(
                key_expression,
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                priority=zenoh.Priority.BACKGROUND if is_last else zenoh.Priority.DATA,
            )
            for reply in replies:
                if reply.ok is None or len(reply.ok.payload) > left:
                    continue
                left -= len(reply.ok.payload)
                answers.append(copy_sample(reply.ok, self._clock.now_ns()))
        return answers

    def declare_alive(self, key: str) -> Subscriber:
        """Let everybody see that this session is there, until it closes or its process ends."""
        with _naming(WireConfigError, f"cannot be seen as {key!r}"):
            token = Subscriber(self._inner.liveliness().declare_token(key))
        self._alive.append(token)  # zenoh withdraws a token that nobody holds
        return token

    def query_alive(self, key_expression: str, *, timeout_s: float = 5.0) -> list[str]:
        """Return the keys of everybody who is there now."""
        with _naming(WireError, f"cannot ask {key_expression}"):
            replies = self._inner.liveliness().get(key_expression, timeout=timeout_s)
            return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def watch_alive(self, key_expression: str, callback: Callable[[str, bool], None]) -> Subscriber:
        """Hear who is there, comes and goes, on the network thread."""

        def on_sample(sample: Any) -> None:
            callback(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        handler = zenoh.handlers.Callback(on_sample, indirect=False)
        with _naming(WireConfigError, f"cannot watch {key_expression!r}"):
            alive = self._inner.liveliness()
            return Subscriber(alive.declare_subscriber(key_expression, handler, history=True))

    def close(self) -> None:
        """Finish answering, say the last words, then leave the network."""
        for service in self._services:
            service.close()
        self._services.clear()
        with contextlib.suppress(zenoh.ZError):  # closed already
            for querier, words in self._last_words:
                is_heard = querier.matching_status.matching  # or not yet known
                replies = self._inner.get(
                    querier.key_expr,
                    payload=words(b""),
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    priority=zenoh.Priority.BACKGROUND,
                    timeout=CLOSE_S if is_heard else UNHEARD_S,
                )
                list(replies)
        self._last_words.clear()
        for token in self._alive:
            token.close()
        self._alive.clear()
        if not self._inner.is_closed():
            self._inner.close()

    def __enter__(self) -> "WireSession":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close."""
        self.close()


@contextlib.contextmanager
def _naming(kind: type[GstError], what: str) -> Iterator[None]:
    """Say what could not be done where zenoh refuses it."""
    try:
        yield
    except zenoh.ZError as error:
        raise kind(f"{what}: {cause_of(error)}.") from error


def open_session(config: WireConfig) -> WireSession:
    """Open a session: loopback unless told otherwise, and never by multicast scouting."""
    try:
        inner: Any = zenoh.open(zenoh_config(config))
    except zenoh.ZError as error:
        cause = cause_of(error)
        if "in use" in cause:
            raise PortTakenError(endpoint=" or ".join(config.listen)) from error
        if "Unable to connect" in cause or "Timeout" in cause:
            raise NoPeerError(endpoints=config.connect) from error
        where = public(", ".join(config.listen + config.connect))
        raise WireConfigError(
            f"cannot open a zenoh session on {where}: {cause}. "
            "An endpoint looks like tcp/127.0.0.1:7447."
        ) from error
    try:
        return WireSession(inner, shared_memory_mb=config.shared_memory_mb, config=config)
    except WireConfigError:
        inner.close()
        raise
