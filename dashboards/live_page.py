"""The page of a recording under way: what a recorder says of itself, heard over zenoh, read-only.

A session is open only while somebody looks. Nothing is asked of the recorder and nothing is sent.
"""

import asyncio
import json
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from bridge.episode import schema
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.messages import CompressedColor
from bridge.errors import GstError
from bridge.record.status import describe_status
from bridge.task.verdict import Verdict
from bridge.wire.config import WireConfig
from bridge.wire.errors import WireError
from bridge.wire.session import WireSample, WireSession, open_session
from dashboards.config import DashboardConfig

STATUS_BYTES, PREVIEW_BYTES = 2_000_000, 1_000_000
"""Larger messages are left out."""
MOST_CAMERAS, MOST_TOPICS, MOST_VERDICTS = 16, 200, 8
MOST_VIEWERS = 16
CONNECT_S, RETRY_S = 1.0, 1.0
QUIET_S = 6.0
"""A recorder that says nothing for so long is looked for again."""
LINGER_S = 10.0
"""The session stays open so long after the last viewer left."""
PERIOD_S = 1.0
"""Viewers are told at most so often."""


@dataclass(frozen=True, kw_only=True)
class TopicLine:
    """One topic of the table."""

    topic: str
    rate_hz: float
    lost: int | None
    """Messages of the episode that were sent and are not in it; None while nothing is recorded."""
    trouble: str
    """Why a person should look; empty where nothing is wrong."""


@dataclass(frozen=True, kw_only=True)
class LiveState:
    """Everything that is known now."""

    is_heard: bool
    problem: str
    """Why nothing is heard; empty where something is."""
    words: str
    """The recorder's own line."""
    state: str
    status: Mapping[str, Any]
    topics: tuple[TopicLine, ...]
    verdicts: tuple[tuple[float, Verdict], ...]
    """How long ago [s], the last first."""
    previews: tuple[tuple[str, int], ...]
    """Camera, and a number that changes with its picture."""
    malformed: int


@dataclass
class _Heard:
    """What was heard last; guarded by the feed's lock."""

    status: dict[str, Any] = field(default_factory=dict)
    status_s: float = 0.0
    previews: dict[str, tuple[int, bytes]] = field(default_factory=dict)
    verdicts: deque[tuple[float, Verdict]] = field(
        default_factory=lambda: deque(maxlen=MOST_VERDICTS)
    )
    malformed: int = 0


class LiveFeed:
    """Listens to one recorder while somebody looks."""

    def __init__(
        self,
        wire: WireConfig,
        recorder: str,
        *,
        open_wire: Callable[[WireConfig], WireSession] = open_session,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Listen to nothing yet.

        Args:
            now_s: A clock that never jumps.
        """
        self._wire, self._recorder = wire, recorder
        self._open_wire, self._now_s = open_wire, now_s
        self._heard = _Heard()
        self._problem = ""
        self._viewers = 0
        self._left_s = 0.0
        self._lock = threading.Lock()
        self._changed = threading.Event()
        self._thread: threading.Thread | None = None
        self.is_ended = False

    @property
    def endpoints(self) -> str:
        """Where the recorder is looked for."""
        return " or ".join(self._wire.connect)

    def enter(self) -> bool:
        """Count a viewer and begin to listen; False where there are too many."""
        with self._lock:
            if self._viewers >= MOST_VIEWERS or self.is_ended:
                return False
            self._viewers += 1
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._listen, name="live", daemon=True)
                self._thread.start()
            return True

    def leave(self) -> None:
        """Count a viewer that left."""
        with self._lock:
            self._viewers -= 1
            self._left_s = self._now_s()

    def end(self) -> None:
        """Stop listening, for good."""
        self.is_ended = True
        self._changed.set()
        thread = self._thread
        if thread is not None:
            thread.join(timeout=2.0)

    def preview(self, camera: str) -> bytes | None:
        """Return the last picture of a camera, a JPEG file."""
        with self._lock:
            found = self._heard.previews.get(camera)
        return None if found is None else found[1]

    def state(self) -> LiveState:
        """Return everything that is known now."""
        with self._lock:
            heard, now_s = self._heard, self._now_s()
            status = dict(heard.status)
            is_heard = bool(status) and now_s - heard.status_s < QUIET_S
            topics = _topics(status) if is_heard else []
            verdicts = tuple((now_s - at_s, v) for at_s, v in reversed(heard.verdicts))
            return LiveState(
                is_heard=is_heard,
                problem="" if is_heard else self._why_not(),
                words=_words(status) if is_heard else "",
                state=str(status.get("state", "")) if is_heard else "",
                status=status if is_heard else {},
                topics=tuple(topics[:MOST_TOPICS]),
                verdicts=verdicts,
                previews=tuple((name, n) for name, (n, _) in sorted(heard.previews.items())),
                malformed=heard.malformed,
            )

    def _why_not(self) -> str:
        return self._problem or f"No recorder {self._recorder!r} is heard at {self.endpoints} yet."

    def _is_watched(self) -> bool:
        with self._lock:
            is_due = self._viewers > 0 or self._now_s() - self._left_s < LINGER_S
            if not is_due or self.is_ended:
                self._thread = None
                return False
            return True

    def _listen(self) -> None:
        while self._is_watched():
            try:
                with self._open_wire(self._wire) as session, ExitStack() as subscribers:
                    for key, hear, most in (
                        (f"rec/{self._recorder}/status", self._hear_status, STATUS_BYTES),
                        (f"rec/{self._recorder}/preview/*", self._hear_preview, PREVIEW_BYTES),
                        ("**/verdict", self._hear_verdict, STATUS_BYTES),
                    ):
                        subscriber = session.subscribe(key, hear, max_bytes=most)
                        subscribers.callback(subscriber.close)
                    self._stay()
            except WireError as error:
                self._problem = str(error)
                self._changed.wait(RETRY_S)
        with self._lock:  # a picture of a session that is over is not live
            self._heard = _Heard() if self._viewers == 0 else self._heard

    def _stay(self) -> None:
        """Hear until nobody looks, or until the recorder falls silent."""
        opened_s = self._now_s()
        while self._is_watched():
            self._changed.wait(0.25)
            with self._lock:
                last_s = max(opened_s, self._heard.status_s)
            if self._now_s() - last_s > QUIET_S:
                self._problem = (
                    f"Something listens at {self.endpoints}, but no recorder named "
                    f"{self._recorder!r} says anything there."
                )
                return

    def _hear_status(self, sample: WireSample) -> None:
        record = _json_of(sample)
        with self._lock:
            if record is None:
                self._heard.malformed += 1
                return
            self._heard.status, self._heard.status_s = record, self._now_s()

    def _hear_verdict(self, sample: WireSample) -> None:
        if sample.type_name not in ("", schema.VERDICT):
            return
        try:
            verdict = Verdict.from_json(sample.data)
        except GstError:
            with self._lock:
                self._heard.malformed += 1
            return
        with self._lock:
            self._heard.verdicts.append((self._now_s(), verdict))

    def _hear_preview(self, sample: WireSample) -> None:
        try:
            picture = CompressedColor.from_cdr(sample.data)
        except MalformedMessageError:
            picture = None
        name = sample.topic.rpartition("/")[2]
        with self._lock:
            known = self._heard.previews
            is_jpeg = picture is not None and picture.data.startswith(b"\xff\xd8")
            if picture is None or not is_jpeg:
                self._heard.malformed += 1
            elif name in known or len(known) < MOST_CAMERAS:
                number = known.get(name, (0, b""))[0] + 1
                known[name] = (number, bytes(picture.data))


def feed_of(config: DashboardConfig) -> LiveFeed:
    """Return the feed that a server offers."""
    wire = WireConfig(
        connect=config.connect, config=config.live_config, connect_timeout_s=CONNECT_S
    )
    return LiveFeed(wire, config.recorder)


async def told(
    feed: LiveFeed,
    render: Callable[[LiveState], Mapping[str, Any]],
    is_gone: Callable[[], Awaitable[bool]],
) -> AsyncIterator[bytes]:
    """Yield server-sent events while a viewer looks: parts of the page that changed."""
    if not feed.enter():
        yield b"event: full\ndata: {}\n\n"
        return
    before: dict[str, Any] = {}
    try:
        while not await is_gone():
            parts = dict(render(feed.state()))
            changed = {name: part for name, part in parts.items() if before.get(name) != part}
            before = parts
            data = json.dumps(changed, allow_nan=False)
            yield f"data: {data}\n\n".encode()
            for _ in range(4):
                if not await is_gone():
                    await asyncio.sleep(PERIOD_S / 4)
    finally:
        feed.leave()


def _json_of(sample: WireSample) -> dict[str, Any] | None:
    try:
        record = json.loads(sample.data)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def _numbers(values: object) -> dict[str, float]:
    """The numbers of a record from another program, by name."""
    if not isinstance(values, dict):
        return {}
    found = {}
    for name, value in list(values.items())[: 2 * MOST_TOPICS]:
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12:
            found[str(name)] = float(value)
    return found


def _words(status: Mapping[str, Any]) -> str:
    try:
        words = describe_status(dict(status))
        return words.removeprefix(str(status.get("state"))).lstrip(",: ")
    except (KeyError, TypeError, ValueError, AttributeError):  # another version of the recorder
        return "This recorder's status cannot be put into words; its numbers are below."


def _topics(status: Mapping[str, Any]) -> list[TopicLine]:
    """Lay out the topics: those with trouble first, then by name."""
    silent = status.get("silent")
    quiet = {
        str(item.get("topic")): f"silent for {item.get('silent_s', 0):.1f} s"
        for item in (silent if isinstance(silent, list) else ())
        if isinstance(item, dict) and isinstance(item.get("silent_s", 0), int | float)
    }
    seen, rate_hz = _numbers(status.get("seen")), _numbers(status.get("rates_hz"))
    missing = status.get("missing")
    absent = {
        text.partition(" ")[0]: "not seen; the contract asks for it"
        for text in (missing if isinstance(missing, list) else ())
        if isinstance(text, str)
    }
    lines = []
    for topic in {**absent, **quiet, **seen}:
        lost = _lost(status, topic)
        trouble = quiet.get(topic) or ("" if seen.get(topic) else absent.get(topic, ""))
        lines.append(
            TopicLine(
                topic=topic,
                rate_hz=rate_hz.get(topic, 0.0),
                lost=lost,
                trouble=trouble or (f"{lost} lost" if lost else ""),
            )
        )
    return sorted(lines, key=lambda line: (not line.trouble, line.topic))


def _lost(status: Mapping[str, Any], topic: str) -> int | None:
    tallies = status.get("topics")
    if not isinstance(tallies, dict):
        return None
    counts = _numbers(tallies.get(topic))
    return int(sum(counts.get(name, 0) for name in ("gaps", "queue_drops")))
