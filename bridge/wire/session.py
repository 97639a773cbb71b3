"""Zenoh sessions: publish, subscribe, serve and ask. The only place that imports zenoh.

Callbacks run on the network thread and get a copy of the bytes at once; they must be quick.
Samples and requests of one client arrive in the order it sent them, so a request that follows
samples finds them already delivered.
"""

import contextlib
import json
import queue
import threading
import traceback
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.errors import GstError, MissingDependencyError
from bridge.wire import attachment, keys
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
)

try:
    import zenoh
except ImportError as import_error:  # pragma: no cover  # needs an environment without zenoh
    raise MissingDependencyError(
        package="eclipse-zenoh", extra="record", purpose="talking to a cell"
    ) from import_error

MAX_WAITING = 32
"""Requests that wait for one service; each may hold a whole plan."""


@dataclass(frozen=True, kw_only=True)
class WireSample:
    """One message as it arrived."""

    topic: str
    type_name: str
    """"" when the publisher did not say."""
    message_encoding: str
    """cdr, json or ""."""
    data: bytes
    source_ns: int | None
    sequence: int | None
    source_gid: bytes | None
    received_ns: int


class Subscriber:
    """A running subscription."""

    def __init__(self, inner: Any) -> None:
        """Use ``WireSession.subscribe``."""
        self._inner = inner

    def close(self) -> None:
        """Stop receiving."""
        with contextlib.suppress(zenoh.ZError):
            self._inner.undeclare()


class WirePublisher:
    """Sends one topic, numbering its messages."""

    def __init__(self, inner: Any) -> None:
        """Use ``WireSession.publisher``."""
        self._inner = inner
        self._sequence = 0
        self.gid = uuid.uuid4().bytes

    def put(self, data: bytes, *, source_ns: int) -> None:
        """Send one serialised message made at ``source_ns``."""
        note = attachment.Attachment(sequence=self._sequence, source_ns=source_ns, gid=self.gid)
        self._sequence += 1
        try:
            self._inner.put(data, attachment=attachment.encode(note))
        except zenoh.ZError as error:
            raise WireError(f"cannot publish: {cause_of(error)}. Is the session open?") from error

    def close(self) -> None:
        """Stop publishing."""
        with contextlib.suppress(zenoh.ZError):
            self._inner.undeclare()


class Service:
    """Answers requests on one key, one after another, on its own thread."""

    def __init__(self, key: str, handler: Callable[[bytes], bytes], max_waiting: int) -> None:
        """Use ``WireSession.serve``."""
        self._handler = handler
        self._max_waiting = max_waiting
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._inner: Any = None
        self._thread = threading.Thread(target=self._work, name=f"serve {key}", daemon=True)
        self._thread.start()

    def _take(self, query: Any) -> None:
        """Queue a request, on the network thread; one too many is refused at once."""
        if self._requests.qsize() < self._max_waiting:
            self._requests.put(query)
            return
        with query, contextlib.suppress(zenoh.ZError):
            query.reply_err(
                f"busy: {self._max_waiting} requests on {query.key_expr} wait already. "
                "Ask again later, or start another one under its own name."
            )

    def _work(self) -> None:
        while (query := self._requests.get()) is not None:
            with query, contextlib.suppress(zenoh.ZError):  # the asker may be gone
                payload = b"" if query.payload is None else query.payload.to_bytes()
                try:
                    query.reply(query.key_expr, self._handler(payload))
                except GstError as error:
                    query.reply_err(str(error))
                except Exception as error:  # noqa: BLE001  # a bug in one answer, not the end
                    traceback.print_exc()
                    query.reply_err(f"internal error: {type(error).__name__}: {error}")

    def close(self) -> None:
        """Stop answering; a request in work is finished first."""
        with contextlib.suppress(zenoh.ZError):
            self._inner.undeclare()
        self._requests.put(None)
        self._thread.join(timeout=5.0)


class WireSession:
    """A live connection; use as a context manager."""

    def __init__(self, inner: Any) -> None:
        """Use ``open_session``."""
        self._inner = inner
        self._clock = AnchoredClock()
        self._services: list[Service] = []

    def now_ns(self) -> int:
        """The clock that stamps ``received_ns``; it never runs backwards."""
        return self._clock.now_ns()

    def publisher(self, topic: str, type_name: str, *, block: bool = True) -> WirePublisher:
        """Announce a topic.

        Args:
            topic: With its leading slash.
            type_name: As in ``bridge.episode.schema``; foreign types count as CDR.
            block: Wait when the network is behind; otherwise the message is lost and the
                receiver sees a gap in the numbers. Control loops must not block.
        """
        known = schema.schema_for(type_name)
        encoding = keys.encoding_of(type_name, known.message_encoding if known else "cdr")
        control = zenoh.CongestionControl
        try:
            inner = self._inner.declare_publisher(
                keys.key_from_topic(topic),
                encoding=encoding,
                congestion_control=control.BLOCK if block else control.DROP,
            )
        except zenoh.ZError as error:
            raise BadTopicError(topic=topic, found=cause_of(error)) from error
        return WirePublisher(inner)

    def subscribe(self, key_expression: str, callback: Callable[[WireSample], None]) -> Subscriber:
        """Receive what matches, for example ``standin/**``, on the network thread."""

        def on_sample(sample: Any) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                callback(_copy(sample, self._clock.now_ns()))

        handler = zenoh.handlers.Callback(on_sample, indirect=False)
        try:
            return Subscriber(self._inner.declare_subscriber(key_expression, handler))
        except zenoh.ZError as error:
            message = f"cannot subscribe to {key_expression!r}: {cause_of(error)}."
            raise WireConfigError(message) from error

    def serve(
        self, key: str, handler: Callable[[bytes], bytes], *, max_waiting: int = MAX_WAITING
    ) -> Service:
        """Answer requests on a key; a ``GstError`` of the handler goes back as the answer.

        Args:
            key: Without a leading slash.
            handler: Called with one request after another.
            max_waiting: Requests that may wait for their turn; further ones are refused.
        """
        service = Service(key, handler, max_waiting)
        callback = zenoh.handlers.Callback(service._take, indirect=False)
        try:
            service._inner = self._inner.declare_queryable(key, callback)
        except zenoh.ZError as error:
            service._requests.put(None)
            raise WireConfigError(f"cannot answer on {key!r}: {cause_of(error)}.") from error
        self._services.append(service)
        return service

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Ask and wait for the answer.

        Raises:
            RemoteError: When the other side refused; carries its message.
            NoReplyError: When nobody answered in time.
        """
        try:
            replies = list(self._inner.get(key, payload=payload, timeout=timeout_s))
        except zenoh.ZError as error:
            raise WireError(f"cannot ask {key}: {cause_of(error)}.") from error
        refusal = None
        for reply in replies:
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
            refusal = reply.err.payload.to_bytes().decode(errors="replace")
        if refusal is None or refusal == "Timeout":
            raise NoReplyError(key=key, timeout_s=timeout_s)
        raise RemoteError(refusal)

    def close(self) -> None:
        """Finish answering, then leave the network."""
        for service in self._services:
            service.close()
        self._services.clear()
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


def open_session(config: WireConfig) -> WireSession:
    """Open a session: loopback unless told otherwise, and never by multicast scouting.

    Raises:
        NoPeerError: When nobody listens at the endpoints within the timeout.
        PortTakenError: When another process listens there already.
        WireConfigError: When the file or an endpoint cannot be understood.
    """
    try:
        return WireSession(zenoh.open(_zenoh_config(config)))
    except zenoh.ZError as error:
        cause = cause_of(error)
        if "in use" in cause:
            raise PortTakenError(endpoint=" or ".join(config.listen)) from error
        if "Unable to connect" in cause or "Timeout" in cause:
            raise NoPeerError(endpoints=config.connect) from error
        where = ", ".join(config.listen + config.connect)
        raise WireConfigError(
            f"cannot open a zenoh session on {where}: {cause}. "
            "An endpoint looks like tcp/127.0.0.1:7447."
        ) from error


def _zenoh_config(config: WireConfig) -> Any:
    """Start from the file where given; mode, endpoints and scouting are ours in any case."""
    settings: dict[str, Any] = {
        "mode": config.mode,
        "connect/endpoints": list(config.connect),
        "listen/endpoints": list(config.listen),
        "connect/timeout_ms": round(config.connect_timeout_s * 1e3),
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # there is nobody to wait for without scouting
    }
    made = zenoh.Config() if config.config is None else _config_from_file(config)
    for key, value in settings.items():
        try:
            made.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise WireConfigError(
                f"{key} = {value!r} is not usable: {cause_of(error)}. "
                "An endpoint looks like tcp/127.0.0.1:7447."
            ) from error
    return made


def _config_from_file(config: WireConfig) -> Any:
    try:
        return zenoh.Config.from_file(str(config.config))
    except zenoh.ZError as error:
        raise WireConfigError(
            f"zenoh configuration {config.config} cannot be read: {cause_of(error)}. "
            "It must be a JSON5 file as zenoh documents it."
        ) from error


def _copy(sample: Any, received_ns: int) -> WireSample:
    topic, ros_type = keys.topic_from_key(str(sample.key_expr))
    type_name, message_encoding = keys.parse_encoding(str(sample.encoding))
    raw = sample.attachment
    note = attachment.decode(None if raw is None else raw.to_bytes())
    return WireSample(
        topic=topic,
        type_name=type_name or ros_type,
        message_encoding=message_encoding or ("cdr" if ros_type else ""),
        data=sample.payload.to_bytes(),
        source_ns=note.source_ns if note else None,
        sequence=note.sequence if note else None,
        source_gid=note.gid if note else None,
        received_ns=received_ns,
    )
