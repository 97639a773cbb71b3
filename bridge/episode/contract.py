"""What a cell's topics promise, and whether a recording shows it: presence, not only gaps.

A contract is a TOML file: ``cell.toml`` in a run folder, or a template of ``datasets/cells``. The
recorder watches it live and keeps a copy in every episode, so that ``check`` judges a file by what
was promised when it was recorded. Without a contract only one thing is judged: a regular stream
that ends long before the recording does.
"""

import json
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec

from bridge.clock import NS_PER_S, s_from_ns
from bridge.data_files import dataset_file
from bridge.episode.health import HealthFinding, parsed
from bridge.episode.metadata import to_strings
from bridge.episode.topics import EVENT, OF_RECORDER, is_latched
from bridge.errors import UsageError

SCHEMA_VERSION = 1
CONTRACT_FILE = "cell.toml"
TEMPLATES = "cells/contracts"
RECORD_NAME = "contract"
"""Of the metadata record that holds an episode's contract."""
PRESENCE_RECORD = "presence"
"""Of the metadata record that holds what was there, by topic."""

REGULAR_MESSAGES = 20
"""A stream with fewer messages has shown no rate."""
REGULAR_SPAN_NS = NS_PER_S
LEAST_SILENCE_S = 1.0
"""Without a contract no shorter silence is remarkable [s]."""
HABIT = 5
"""Without a contract a silence is remarkable beyond so many times the longest one before it."""
SLOW, SLOW_NS = 4, 2 * NS_PER_S
"""Without a contract a rate has collapsed where several gaps in a row are so many times the usual
one, for so long [ns]."""
FEWEST_FOR_RATE = 10
"""A rate is judged when the contract promises at least so many messages."""


Above0 = Annotated[float, msgspec.Meta(gt=0, lt=1e12)]


class ContractError(UsageError):
    """A contract cannot be used."""


class TopicRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one topic promises."""

    rate_hz: Above0 | None = None
    """Messages per second [1/s]; None promises none."""
    tolerance: Above0 = 0.2
    """By which part of it the mean rate may differ."""
    silence_s: Above0 | None = None
    """The longest time without a message [s]; None allows any."""
    required: bool = True
    """Whether a recording without the topic is broken; else it may be absent."""


class Contract(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a cell's topics promise."""

    topics: dict[str, TopicRule]
    cell: str = ""

    def to_record(self) -> dict[str, str]:
        """The ``contract`` metadata record; every value is JSON."""
        return to_strings({"schema_version": SCHEMA_VERSION, **msgspec.to_builtins(self)})

    def required(self) -> list[str]:
        """Topics without which nothing should be recorded."""
        return [topic for topic, rule in self.topics.items() if rule.required]


def read_contract(path: Path) -> Contract:
    """Read a contract."""
    try:
        values = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ContractError(f"the contract {path} cannot be read: {error}.") from error
    return contract_from(values, name=str(path))


def find_contract(run: Path, name: str | None) -> Contract | None:
    """Return the contract of a recording.

    Raises:
        UsageError: When there is no such template; lists those that are there.
    """
    if name is not None:
        return read_contract(dataset_file(TEMPLATES, name))
    path = run / CONTRACT_FILE
    return read_contract(path) if path.is_file() else None


def contract_from(values: Mapping[str, Any], *, name: str) -> Contract:
    """Build a contract from parsed values."""
    version, where, rest = values.get("schema_version"), name, dict(values)
    if version != SCHEMA_VERSION:
        found = "is missing" if version is None else f"is {version!r:.40}"
        raise ContractError(f"{name}: schema_version {found}; it must be {SCHEMA_VERSION}.")
    del rest["schema_version"]
    try:
        for topic, rule in msgspec.convert(rest.get("topics"), dict[str, Any]).items():
            where = f"{name}: topics.{json.dumps(topic)}"
            if not topic.startswith("/"):
                raise ContractError(f"{where}: a topic starts with a slash: /{topic}.")
            msgspec.convert(rule, TopicRule)
        where = name
        return msgspec.convert(rest, Contract)
    except msgspec.ValidationError as error:
        raise ContractError(f"{where}: {error}.") from error


@dataclass(kw_only=True, slots=True)
class Presence:
    """When the messages of one topic were there."""

    messages: int = 0
    first_ns: int = 0
    """0 without messages."""
    last_ns: int = 0
    longest_ns: int = 0
    """The longest silence between two messages."""
    longest_at_ns: int = 0
    usual_ns: float = 0.0
    """Between two messages, as long as the rate does not fall; and how far from it they are."""
    spread_ns: float = 0.0
    slow: tuple[int, int, int] | None = None
    """First and last of the messages that came too slowly for longest, and how many."""
    slow_now: tuple[int, int] = (0, 0)

    def see(self, stamp_ns: int) -> None:
        """Take the next message."""
        self.messages += 1
        last_ns = self.last_ns
        if not last_ns:
            self.first_ns = self.last_ns = stamp_ns
            return
        if stamp_ns <= last_ns:
            return
        self.last_ns = stamp_ns
        self._see_rate(last_ns, stamp_ns - last_ns)
        if stamp_ns - last_ns > self.longest_ns:
            self.longest_ns, self.longest_at_ns = stamp_ns - last_ns, last_ns

    def _see_rate(self, last_ns: int, gap_ns: int) -> None:
        """Learn the usual gap, and follow gaps that are far longer in a regular stream."""
        usual_ns = self.usual_ns
        is_steady = self.messages > REGULAR_MESSAGES and self.spread_ns < usual_ns / 2
        if is_steady and gap_ns > SLOW * usual_ns:
            first_ns, count = self.slow_now if self.slow_now[1] else (last_ns, 0)
            self.slow_now = (first_ns, count + 1)
            before = self.slow[1] - self.slow[0] if self.slow else 0
            if count and last_ns + gap_ns - first_ns > max(before, SLOW_NS):
                self.slow = (first_ns, last_ns + gap_ns, count + 1)
            return
        self.slow_now = (0, 0)
        part = 1 / min(self.messages - 1, REGULAR_MESSAGES)
        self.usual_ns += (gap_ns - usual_ns) * part
        self.spread_ns += (abs(gap_ns - self.usual_ns) - self.spread_ns) * part

    @property
    def is_regular(self) -> bool:
        """Whether it has shown a rate, so that an end of it is remarkable."""
        return self.messages >= REGULAR_MESSAGES and self.last_ns - self.first_ns >= REGULAR_SPAN_NS


class Span(NamedTuple):
    """What was to be recorded."""

    start_ns: int
    end_ns: int


@dataclass(frozen=True, kw_only=True)
class TopicReport:
    """What one topic shows over a recording."""

    messages: int
    first_s: float | None
    """After the recording's start [s]; None without messages."""
    last_s: float | None
    longest_silence_s: float
    """Between two messages [s]; what is before the first and after the last is not among it."""
    longest_silence_at_s: float
    """When it began, after the recording's start [s]."""
    tail_s: float
    """From the last message to the recording's end [s]."""
    expected: int | None
    """Messages the contract promises for this time; None when it promises no rate."""
    tail: str
    """``known``, or ``unknown``: it fell silent, and nobody knows what was sent after."""
    breaches: tuple[str, ...] = ()
    slow: tuple[int, int, int] | None = None
    """From when to when it came too slowly [ns], and how many; None: never, or a contract says."""


def judge(
    presences: Mapping[str, Presence],
    contract: Contract | None,
    span: Span,
    lost: Mapping[str, int],
    *,
    by_habit: bool = True,
) -> dict[str, TopicReport]:
    """Compare what was there with what was promised.

    Args:
        lost: By topic, messages that were sent and are not in the episode; they are not taken for
            silence of their publisher.
        by_habit: Judge topics without a rule by what they did before. Not for a stand-in cell:
            its clock is not the wall's, and may stand.
    """
    rules, absent = contract.topics if contract else {}, Presence()
    total_ns = max(0, span.end_ns - span.start_ns)
    reports = {}
    for topic in sorted({*presences, *rules} - OF_RECORDER):
        presence, rule = presences.get(topic, absent), rules.get(topic)
        rate_hz = rule.rate_hz if rule else None
        was_there = presence.messages > 0
        tail_ns = max(0, span.end_ns - presence.last_ns) if was_there else total_ns
        is_silent = _fell_silent(topic, presence, rule, tail_ns, by_habit)
        longest_at_ns = presence.longest_at_ns - span.start_ns if presence.longest_ns else 0
        found = _breaches(presence, rule, span, lost.get(topic, 0)) if rule else ()
        reports[topic] = TopicReport(
            messages=presence.messages,
            first_s=s_from_ns(presence.first_ns - span.start_ns) if was_there else None,
            last_s=s_from_ns(presence.last_ns - span.start_ns) if was_there else None,
            longest_silence_s=s_from_ns(presence.longest_ns),
            longest_silence_at_s=s_from_ns(longest_at_ns),
            tail_s=s_from_ns(tail_ns),
            expected=None if rate_hz is None else round(rate_hz * s_from_ns(total_ns)),
            tail="unknown" if is_silent else "known",
            breaches=tuple(found),
            slow=presence.slow if by_habit and rule is None and not _is_rare(topic) else None,
        )
    return reports


def _is_rare(topic: str) -> bool:
    """Whether messages come when something happens."""
    return is_latched(topic) or topic.endswith(EVENT)


def _fell_silent(
    topic: str, presence: Presence, rule: TopicRule | None, tail_ns: int, by_habit: bool
) -> bool:
    if rule is not None:
        limit_s = rule.silence_s
        return limit_s is not None and presence.messages > 0 and s_from_ns(tail_ns) > limit_s
    if not by_habit or _is_rare(topic) or not presence.is_regular:
        return False
    return s_from_ns(tail_ns) > max(LEAST_SILENCE_S, HABIT * s_from_ns(presence.longest_ns))


def _breaches(presence: Presence, rule: TopicRule, span: Span, lost: int) -> Iterable[str]:
    if not presence.messages:
        if rule.required:
            yield "no message, and the contract requires it"
        return
    dropped = f" ({lost} messages of it were dropped)" if lost else ""
    limit_s = rule.silence_s
    if limit_s is not None:
        allowed = f"at most {limit_s:g} s is allowed{dropped}"
        head_s = s_from_ns(presence.first_ns - span.start_ns)
        tail_s = s_from_ns(span.end_ns - presence.last_ns)
        longest_s = s_from_ns(presence.longest_ns)
        if head_s > limit_s and rule.required:
            yield f"silent for the first {head_s:.1f} s; {allowed}"
        if longest_s > limit_s:
            at_s = s_from_ns(presence.longest_at_ns - span.start_ns)
            yield f"silent for {longest_s:.1f} s from {at_s:.1f} s on; {allowed}"
        if tail_s > limit_s:
            yield f"silent for the last {tail_s:.1f} s; {allowed}"
    yield from _rate_breach(presence, rule, lost)


def _rate_breach(presence: Presence, rule: TopicRule, lost: int) -> Iterable[str]:
    there_s = s_from_ns(presence.last_ns - presence.first_ns)
    if rule.rate_hz is None or rule.rate_hz * there_s < FEWEST_FOR_RATE:
        return
    found_hz = (presence.messages + lost - 1) / there_s
    if abs(found_hz - rule.rate_hz) > rule.tolerance * rule.rate_hz:
        yield (
            f"{found_hz:.1f} messages a second; the contract says {rule.rate_hz:g} "
            f"± {100 * rule.tolerance:g} %"
        )


def findings_of(
    reports: Mapping[str, TopicReport],
    presences: Mapping[str, Presence],
    end_ns: int,
    untold: Collection[str] = (),
) -> Iterator[HealthFinding]:
    """Say where a contract was broken, what fell silent or ended untold, and whose rate fell."""
    if not any(presences[topic].messages for topic in presences.keys() - OF_RECORDER):
        yield HealthFinding(name="nothing_recorded", about="all topics", text="no message came")
    for topic, report in reports.items():
        presence = presences.get(topic, Presence())
        span = {"first_ns": presence.first_ns, "last_ns": presence.last_ns}
        for text in report.breaches:
            yield HealthFinding(name="contract_broken", about=topic, text=text, **span)
        if report.tail == "unknown":
            text = f"nothing came in the last {report.tail_s:.1f} s"
            span = {"first_ns": presence.last_ns, "last_ns": end_ns}
            yield HealthFinding(name="tail_unknown", about=topic, text=text, **span)
        elif topic in untold:
            text = "in the end its source did not say how many messages it had sent"
            yield HealthFinding(name="tail_untold", about=topic, text=text, **span)
        if report.slow is not None:
            first_ns, last_ns, count = report.slow
            text = (
                f"{count / s_from_ns(last_ns - first_ns):.1f} messages a second instead of "
                f"{NS_PER_S / presence.usual_ns:.1f}"
            )
            span = {"first_ns": first_ns, "last_ns": last_ns}
            yield HealthFinding(name="rate_collapsed", about=topic, text=text, count=count, **span)


def unseen_losses(unnumbered: Mapping[str, int]) -> list[str]:
    """Sentences on topics whose losses nobody can see, by their number of such messages."""
    return [
        f"{topic}: {count} messages carry no sequence number; losses of it cannot be seen"
        for topic, count in sorted(unnumbered.items())
        if count
    ]


def health_lines(record: Mapping[str, Any], start_ns: int = 0) -> list[str]:
    """Sentences on what the records ``health`` and ``presence``, or the answer to a stop, say."""
    unnumbered = record.get("unnumbered")
    return [
        *(found.line(start_ns) for found in parsed(record.get("findings"))),
        *unseen_losses(unnumbered if isinstance(unnumbered, dict) else {}),
    ]
