"""Whether everybody who should speak does, and whether the recorder hears at all.

The recorder sends itself a heartbeat over the network. Time counts as silence of a topic only while
heartbeats are heard: a recorder that was stopped, starved or deaf blames no publisher.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from bridge.episode.contract import Contract, TopicRule
from bridge.episode.topics import is_latched
from bridge.wire.errors import WireError
from bridge.wire.qos import Qos
from bridge.wire.session import WireSession

BEAT_S = 0.1
MAX_STEP_S = 1.5 * BEAT_S
"""One heartbeat proves at most so much hearing [s]."""
DEAF_S = 0.7
"""A heartbeat that is not heard for so long means that nothing is [s]."""
STARVED_S = 0.7
"""A heartbeat that is sent so late means that the recorder itself stood still [s]."""
FIRST_BEAT_S = 3.0
"""Without any heartbeat for so long the network does not let us hear ourselves [s]."""
SILENCE_S = 0.75
"""Without a contract no shorter silence of a regular stream is told [s]."""
HABIT = 3
"""Without a contract a silence is told beyond so many times the longest one before."""
REGULAR_MESSAGES = 20
REGULAR_HZ = 2.0


@dataclass(frozen=True, kw_only=True)
class Silence:
    """One topic that should speak and does not."""

    topic: str
    silent_s: float
    required: bool = False
    cause: str = ""
    """What else is known: its publisher left."""

    def __str__(self) -> str:
        """Words for a status line."""
        cause = f" ({self.cause})" if self.cause else ""
        return f"{self.topic} silent for {self.silent_s:.1f} s{cause}"


@dataclass(frozen=True, kw_only=True)
class News:
    """Something a person should hear of at once."""

    text: str
    data: dict[str, Any]
    warns: bool = False
    """Also kept among the episode's warnings, which ``check`` shows."""


@dataclass(kw_only=True, slots=True)
class _Topic:
    seen: int
    age_s: float = 0.0
    """Heard time since its first message."""
    quiet_s: float = 0.0
    """Heard time since its last message."""
    longest_s: float = 0.0
    """The longest silence that was not told."""
    is_told: bool = False
    is_expected: bool = True
    """False for one that was silent when the episode began."""


def _is_of(topic: str, prefix: str, others: tuple[str, ...]) -> bool:
    return topic.startswith(prefix) and not topic.startswith(others)


class PresenceMonitor:
    """Follows all topics, by heartbeats. ``heard`` and ``tick`` may come from different threads."""

    def __init__(
        self,
        seen: Callable[[], Mapping[str, int]],
        *,
        tell: Callable[[News], None] = lambda news: None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to listen."""
        self.contract: Contract | None = None
        self.starved_s = 0.0
        """How long the recorder stood still in all [s]."""
        self._seen = seen
        self._tell = tell
        self._now_s = now_s
        self._lock = threading.Lock()
        self._topics: dict[str, _Topic] = {}
        self._gone: dict[str, tuple[str, ...]] = {}
        """Beginnings of topics whose publisher left; with each, longer ones that were there."""
        self._is_recording = False
        self._by_habit = True
        begun_s = now_s()
        self._begun_s = self._ticked_s = self._heard_s = begun_s
        self._was_heard = False
        self._deaf_since_s: float | None = None

    def heard(self) -> None:
        """Take a heartbeat that came back; on the network thread."""
        with self._lock:
            now_s = self._now_s()
            step_s = min(now_s - self._heard_s, MAX_STEP_S)
            self._heard_s = now_s
            self._was_heard = True
            news = self._hears_again(now_s)
            news += self._follow(step_s)
        for each in news:
            self._tell(each)

    def tick(self) -> None:
        """Look whether heartbeats come back; called about every ``BEAT_S``, after one was sent."""
        news: list[News] = []
        with self._lock:
            now_s = self._now_s()
            late_s, self._ticked_s = now_s - self._ticked_s, now_s
            if late_s > STARVED_S:
                self.starved_s += late_s
                self._heard_s = now_s  # nothing could be heard: begin anew
                text = f"the recorder itself stood still for {late_s:.1f} s"
                news += self._while_recording(text, {"kind": "starved", "for_s": late_s})
            elif not self._was_heard:
                if now_s - self._begun_s > FIRST_BEAT_S:  # here every tick counts as heard
                    news += self._follow(min(late_s, MAX_STEP_S))
            elif now_s - self._heard_s > DEAF_S and self._deaf_since_s is None:
                self._deaf_since_s = self._heard_s
                text = (
                    f"the recorder has heard nothing for {now_s - self._heard_s:.1f} s, not even "
                    "itself; what is published now may be missing"
                )
                news += self._while_recording(text, {"kind": "deaf"})
        for each in news:
            self._tell(each)

    def _hears_again(self, now_s: float) -> list[News]:
        if self._deaf_since_s is None:
            return []
        deaf_s = now_s - self._deaf_since_s
        self._deaf_since_s = None
        text = f"the recorder hears again; it was deaf for {deaf_s:.1f} s"
        return self._while_recording(text, {"kind": "hears_again", "for_s": deaf_s})

    def _while_recording(self, text: str, data: dict[str, Any]) -> list[News]:
        return [News(text=text, data=data)] if self._is_recording else []

    def _follow(self, step_s: float) -> list[News]:
        """Let time pass for all topics in which the recorder could hear them."""
        news = []
        for name, count in self._seen().items():
            topic = self._topics.get(name)
            if topic is None:
                self._topics[name] = _Topic(seen=count)
                continue
            topic.age_s += step_s
            if count == topic.seen:
                topic.quiet_s += step_s
                if not topic.is_told and self._is_silent(name, topic):
                    topic.is_told = True
                    silence = self._silence(name, topic)
                    news += self._while_recording(
                        str(silence), {"kind": "silent", **asdict(silence)}
                    )
                continue
            if topic.is_told:
                text = f"{name} is back after {topic.quiet_s:.1f} s"
                data = {"kind": "back", "topic": name, "silent_s": topic.quiet_s}
                news += self._while_recording(text, data)
            else:
                topic.longest_s = max(topic.longest_s, topic.quiet_s)
            topic.seen, topic.quiet_s, topic.is_told, topic.is_expected = count, 0.0, False, True
        return news

    def _rule(self, name: str) -> TopicRule | None:
        return self.contract.topics.get(name) if self.contract else None

    def _is_silent(self, name: str, topic: _Topic) -> bool:
        rule = self._rule(name)
        if rule is not None:
            return rule.silence_s is not None and topic.quiet_s > rule.silence_s
        if (
            not self._by_habit
            or not topic.is_expected
            or is_latched(name)
            or topic.seen < REGULAR_MESSAGES
        ):
            return False
        speaking_s = topic.age_s - topic.quiet_s
        if speaking_s * REGULAR_HZ > topic.seen:
            return False
        return topic.quiet_s > max(SILENCE_S, HABIT * topic.longest_s)

    def _silence(self, name: str, topic: _Topic) -> Silence:
        has_left = any(_is_of(name, prefix, others) for prefix, others in self._gone.items())
        rule = self._rule(name)
        return Silence(
            topic=name,
            silent_s=round(topic.quiet_s, 2),
            required=rule is not None and rule.required,
            cause="its publisher left" if has_left else "",
        )

    def begin(self, *, by_habit: bool = True) -> None:
        """An episode begins: what was silent before is not missed, unless the contract says so.

        Args:
            by_habit: Miss topics without a rule too. Not of a stand-in cell: its clock may stand.
        """
        with self._lock:
            self._by_habit = by_habit
            for name, topic in self._topics.items():
                if self._is_silent(name, topic):
                    topic.is_expected = False
            self._is_recording = True

    def end(self) -> None:
        """Nothing is recorded now: nobody need be told."""
        with self._lock:
            self._is_recording = False

    def publisher(self, prefix: str, *, is_there: bool, others: tuple[str, ...] = ()) -> None:
        """Note that the publisher of topics that begin so came or left."""
        news = []
        with self._lock:
            if is_there:
                self._gone.pop(prefix, None)
            else:
                self._gone[prefix] = others
                if any(_is_of(name, prefix, others) for name in self._topics):
                    text = f"the publisher of {prefix} left"
                    news = self._while_recording(text, {"kind": "left", "topic": prefix})
        for each in news:
            self._tell(each)

    def silences(self) -> list[Silence]:
        """Every topic that should speak now and does not."""
        with self._lock:
            return [
                self._silence(name, topic)
                for name, topic in self._topics.items()
                if self._is_silent(name, topic)
            ]

    def missing(self, contract: Contract | None) -> list[str]:
        """Sentences on the topics that a contract requires and that are not there now."""
        seen = self._seen()
        silent = {silence.topic: silence for silence in self.silences()}
        missing = []
        for topic in contract.required() if contract else []:
            if not seen.get(topic):
                missing.append(f"{topic} has not been seen")
            elif topic in silent:
                missing.append(f"{silent[topic]}")
        return missing

    def status(self) -> dict[str, Any]:
        """What goes into the recorder's status."""
        silences = self.silences()
        with self._lock:
            deaf_s = 0.0 if self._deaf_since_s is None else self._now_s() - self._deaf_since_s
        return {
            "silent": [asdict(silence) for silence in silences],
            "missing": self.missing(self.contract),
            "deaf_s": round(deaf_s, 1),
            "starved_s": round(self.starved_s, 1),
        }


class Heartbeat:
    """Sends the recorder a heartbeat from a session of its own, through the network."""

    def __init__(
        self,
        session: WireSession,
        recorder: str,
        monitor: PresenceMonitor,
        say: Callable[[str], None],
    ) -> None:
        """Begin to beat."""
        self._monitor = monitor
        self._ended = threading.Event()
        self._loopback: WireSession | None = None
        key = f"rec/{recorder}/heartbeat"
        self._subscriber = session.subscribe(key, lambda sample: monitor.heard())
        try:
            self._loopback = session.open_loopback()
            self._publisher = self._loopback.publisher(f"/{key}", "", qos=Qos.CONTROL)
        except WireError as error:
            say(f"note: the recorder cannot watch its own hearing: {error}")
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        self._thread.start()

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            if self._loopback is not None:
                with contextlib.suppress(WireError):  # closing, or the very deafness we look for
                    self._publisher.put(b"", source_ns=self._loopback.now_ns())
            self._monitor.tick()

    def close(self) -> None:
        """Stop."""
        self._ended.set()
        self._thread.join(timeout=1.0)
        self._subscriber.close()
        if self._loopback is not None:
            self._loopback.close()
