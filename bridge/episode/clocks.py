"""Clocks of the hosts that published: measured by round trips, fitted, and taken out of stamps.

A reading of a round trip holds the true offset between its two ends (Cristian 1989), whatever the
network did. From those the recorder wrote into the episode follows a straight line for each source:
offset, drift, and how far the truth can be from the line. A reading that agrees with none before
it means that the clock was set: a new line begins there.
"""

import contextlib
import json
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from mcap import records

from bridge.clock import NS_PER_S, ClockChoice, join_ns, split_ns
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.reader import Episode, RawMessage
from bridge.episode.topics import CLOCKS
from bridge.errors import EpisodeError

SLEW = 500e-6
"""A clock that is trimmed gains or loses at most this part of the time that passes (adjtime)."""
SMALLEST_JUMP_NS = 1_000_000
COMPARED = 30
"""Readings before it that a new one must agree with."""
DRIFT_SPAN_S = 20.0
"""Readings of a shorter time say nothing of drift."""
LIVE_NS = 60 * NS_PER_S
"""Stamps further from the present are no live clock: somebody plays an episode back."""
STAMP_JUMP_NS = 50_000_000
"""Stamps that move ahead by this much moved with their clock: no way becomes so much shorter."""
STAMP_LAG_NS = 1_000_000_000
"""Stamps that fall behind by less may also have waited for the network."""


class Reading(NamedTuple):
    """One round trip: recorder, source, recorder."""

    at_ns: int
    """Its middle, by the recorder's clock."""
    offset_ns: int
    """Source minus recorder; the truth is within ``error_ns`` of it."""
    error_ns: int
    """Half of what the network took, both ways together."""


class Jump(NamedTuple):
    """A clock that was set."""

    at_ns: int
    """When it was noticed, by the recorder's clock."""
    by_ns: int
    """How far, ahead is positive."""


def read_round_trip(*, asked_ns: int, received_ns: int, sent_ns: int, back_ns: int) -> Reading:
    """Turn the four times of a round trip into an offset and its bound."""
    most_ns, least_ns = received_ns - asked_ns, sent_ns - back_ns
    return Reading(
        at_ns=(asked_ns + back_ns) // 2,
        offset_ns=(most_ns + least_ns) // 2,
        error_ns=max(1, (most_ns - least_ns + 1) // 2),
    )


def jump_of(before: Sequence[Reading], new: Reading) -> Jump | None:
    """Say whether a reading contradicts those before it; None where it agrees with all."""
    for old in before[-COMPARED:]:
        allowed_ns = old.error_ns + new.error_ns + SLEW * abs(new.at_ns - old.at_ns)
        if abs(new.offset_ns - old.offset_ns) > allowed_ns + SMALLEST_JUMP_NS:
            best = min(before[-COMPARED:], key=lambda reading: reading.error_ns)
            return Jump(new.at_ns, new.offset_ns - best.offset_ns)
    return None


@dataclass(frozen=True, kw_only=True)
class ClockLine:
    """Offset of one source's clock over a time in which nobody set it."""

    start_ns: int
    """First and last reading, by the recorder's clock."""
    end_ns: int
    offset_ns: float
    """At the middle of that time; the source is ahead where it is positive."""
    drift: float | None
    """Seconds gained in a second; None where the time was too short to tell."""
    uncertainty_ns: float
    """The truth is at most this far from the line at each reading that was used."""
    readings: int

    def offset_at(self, at_ns: int) -> float:
        """Source minus recorder at a time of the recorder's clock [ns]."""
        return self.offset_ns + (self.drift or 0.0) * (at_ns - (self.start_ns + self.end_ns) // 2)


def fit_line(readings: Sequence[Reading]) -> ClockLine:
    """Fit offset and drift to the quicker half of the readings, the quickest counting most."""
    limit_ns = statistics.median_low(reading.error_ns for reading in readings)
    used = [reading for reading in readings if reading.error_ns <= limit_ns]
    start_ns = min(reading.at_ns for reading in readings)
    end_ns = max(reading.at_ns for reading in readings)
    middle_ns = (start_ns + end_ns) // 2
    weights = 1.0 / np.array([reading.error_ns for reading in used], dtype=np.float64) ** 2
    t = np.array([reading.at_ns - middle_ns for reading in used], dtype=np.float64)
    o = np.array([reading.offset_ns for reading in used], dtype=np.float64)
    mean_t, mean_o = np.average(t, weights=weights), np.average(o, weights=weights)
    drift = None
    if np.ptp(t) >= DRIFT_SPAN_S * NS_PER_S:
        shared = np.sum(weights * (t - mean_t) * (o - mean_o))
        drift = float(shared / np.sum(weights * (t - mean_t) ** 2))
    offset_ns = float(mean_o - (drift or 0.0) * mean_t)
    off_ns = np.abs(offset_ns + (drift or 0.0) * t - o)
    return ClockLine(
        start_ns=start_ns,
        end_ns=end_ns,
        offset_ns=offset_ns,
        drift=drift,
        uncertainty_ns=float(max(d + r.error_ns for d, r in zip(off_ns, used, strict=True))),
        readings=len(readings),
    )


@dataclass(kw_only=True)
class SourceClock:
    """What is known of the clock of one source."""

    source: str
    """Beginning of its topics, such as ``lab`` or ``lab/cam/side``."""
    host: str
    topics: frozenset[str] = frozenset()
    spans: list[list[Reading]] = field(default_factory=list)
    """Readings, a new list each time the clock was set."""
    jumps: list[Jump] = field(default_factory=list)

    def add(self, reading: Reading) -> Jump | None:
        """Take a reading, later than those before; return the jump it shows."""
        if not self.spans:
            self.spans.append([reading])
            return None
        jump = jump_of(self.spans[-1], reading)
        if jump is None:
            self.spans[-1].append(reading)
        else:
            self.spans.append([reading])
            self.jumps.append(jump)
        return jump

    def lines(self) -> list[ClockLine]:
        """A line for each time between two jumps."""
        return [fit_line(span) for span in self.spans]

    def sentences(self) -> list[str]:
        """What people are told."""
        line = self.lines()[-1]
        side = "ahead of" if line.offset_ns >= 0 else "behind"
        drift = "" if line.drift is None else f", drift {line.drift * 1e6:+.1f} ppm"
        text = (
            f"clock of {self.source} on {self.host}: {_in_words(abs(line.offset_ns))} {side} the "
            f"recorder's, within {_in_words(line.uncertainty_ns)}{drift}"
        )
        return [text, *(told_jump(self.source, self.host, jump) for jump in self.jumps)]


def told_jump(source: str, host: str, jump: Jump) -> str:
    """Name a clock that was set."""
    sign = "ahead" if jump.by_ns > 0 else "back"
    return f"the clock of {source} on {host} was set {sign} by {_in_words(abs(jump.by_ns))}"


def _in_words(time_ns: float | int) -> str:
    return f"{time_ns / 1e9:.3f} s" if time_ns >= NS_PER_S else f"{time_ns / 1e6:.3f} ms"


class StampWatch:
    """Notices a clock that was set by the stamps alone, from the least delay in each second.

    For publishers that nobody can ask. A topic's level before and after the step must each last two
    seconds, so that neither a stall nor a playback at another rate is taken for one.
    """

    def __init__(self) -> None:
        """Know no topic."""
        self._levels: dict[str, list[int]] = {}

    def see(self, topic: str, delay_ns: int) -> int:
        """Take the least (arrival - stamp) of the next second; return how far they jumped ahead."""
        levels = self._levels.setdefault(topic, [])
        levels.append(delay_ns)
        del levels[:-4]
        if len(levels) < 4:  # two seconds before, two after
            return 0
        first, second, third, fourth = levels
        ahead_ns = second - third
        is_step = abs(first - second) < STAMP_JUMP_NS and abs(third - fourth) < STAMP_JUMP_NS
        is_far = ahead_ns > STAMP_JUMP_NS or ahead_ns < -STAMP_LAG_NS
        is_live = min(abs(second), abs(third)) < LIVE_NS
        return ahead_ns if is_step and is_far and is_live else 0


# In the episode


class ClockRecord(msgspec.Struct, kw_only=True):
    """One message of ``/recorder/clocks``."""

    source: str
    id: str
    topics: list[str]
    readings: list[Reading]
    host: str = ""


def to_record(clock: SourceClock, identity: str, readings: Iterable[Reading]) -> dict[str, Any]:
    """Make the record of ``/recorder/clocks``."""
    record = ClockRecord(
        source=clock.source,
        id=identity,
        topics=sorted(clock.topics),
        readings=list(readings),
        host=clock.host,
    )
    return {"schema_version": 1, **msgspec.to_builtins(record)}


class StampCorrection:
    """Turns stamps of the sources' clocks into times of the recorder's clock."""

    def __init__(self, clocks: Sequence[SourceClock]) -> None:
        """Prepare the lines by topic."""
        self._lines: dict[str, list[tuple[SourceClock, ClockLine]]] = {}
        for clock in clocks:
            for line in clock.lines():
                for topic in clock.topics:
                    self._lines.setdefault(topic, []).append((clock, line))

    @property
    def topics(self) -> frozenset[str]:
        """Topics whose source answered."""
        return frozenset(self._lines)

    def shift_ns(self, topic: str, publish_ns: int, log_ns: int) -> int:
        """What must be added to a stamp; 0 where nobody knows the topic's clock.

        Of several lines the one that holds at the time counts; between two, the one that puts the
        message closest to its arrival. Sources that share a topic and differ are left alone.
        """
        known = self._lines.get(topic)
        if not known:
            return 0
        holding = [pair for pair in known if pair[1].start_ns <= log_ns <= pair[1].end_ns]
        if holding:
            offsets = [line.offset_at(log_ns) for _, line in holding]
            bound_ns = sum(line.uncertainty_ns for _, line in holding)
            if max(offsets) - min(offsets) > bound_ns:
                return 0
            best = min((line for _, line in holding), key=lambda line: line.uncertainty_ns)
            return -round(best.offset_at(log_ns))
        away = [max(line.start_ns - log_ns, log_ns - line.end_ns) for _, line in known]
        near = [
            line for (_, line), far in zip(known, away, strict=True) if far <= sorted(away)[:2][-1]
        ]
        return min(
            (-round(line.offset_at(log_ns)) for line in near),
            key=lambda shift_ns: abs(log_ns - (publish_ns + shift_ns)),
        )


def restamped(message: RawMessage, definition: records.Schema | None, shift_ns: int) -> RawMessage:
    """Move the time of a message, and the time it holds itself, where its type has one."""
    publish_ns = max(0, message.publish_time_ns + shift_ns)
    data = message.data
    with contextlib.suppress(codec.MalformedMessageError, ValueError, AttributeError):
        data = _restamped_data(message.type_name, definition, data, shift_ns)
    return message._replace(publish_time_ns=publish_ns, data=data)


def _restamped_data(
    type_name: str, definition: records.Schema | None, data: bytes, shift_ns: int
) -> bytes:
    if type_name == schema.TF_MESSAGE:
        message = codec.decode(type_name, data)
        for item in message["transforms"]:
            stamp = item["header"]["stamp"]
            stamp["sec"], stamp["nanosec"] = _moved(stamp["sec"], stamp["nanosec"], shift_ns)
        return codec.encode(type_name, message)
    if definition is None:
        return data
    if definition.encoding == "jsonschema":
        return _restamped_json(data, shift_ns)
    if definition.encoding != "ros2msg" or not codec.begins_with_header(definition.data):
        return data
    stamp = codec.header_stamp(data)
    return data if stamp is None else codec.with_header_stamp(data, *_moved(*stamp, shift_ns))


def _moved(sec: int, nanosec: int, shift_ns: int) -> tuple[int, int]:
    stamp_ns = join_ns(sec, nanosec)
    return split_ns(max(0, stamp_ns + shift_ns)) if stamp_ns else (sec, nanosec)


def _restamped_json(data: bytes, shift_ns: int) -> bytes:
    record = json.loads(data)
    stamp_ns = record.get("stamp_ns")
    if not isinstance(stamp_ns, int) or isinstance(stamp_ns, bool) or stamp_ns <= 0:
        return data
    return json.dumps({**record, "stamp_ns": max(0, stamp_ns + shift_ns)}).encode()


def clocks_of(episode: Episode) -> list[SourceClock]:
    """What an episode says of the clocks of its sources; empty where nobody measured them."""
    found: dict[tuple[str, str], SourceClock] = {}
    for message in episode.messages([CLOCKS]):
        try:
            record = msgspec.json.decode(message.data, type=ClockRecord)
        except msgspec.DecodeError:
            continue
        clock = SourceClock(source=record.source, host=record.host)
        clock = found.setdefault((record.source, record.id), clock)
        clock.topics |= {*record.topics}
        for reading in record.readings:
            clock.add(reading)
    return [clock for clock in found.values() if clock.spans]


class CorrectedEpisode(Episode):
    """An episode whose sources' stamps are read in the time of the recorder's clock."""

    def __init__(self, episode: Episode) -> None:
        """Use ``open_episode``."""
        super().__init__(episode.file)
        self._correction = StampCorrection(clocks_of(episode))
        self._definitions: dict[tuple[str, str], records.Schema] = {}
        for channel in self.file.summary.channels.values():
            record = self.file.schema_of(channel)
            if record is not None:
                self._definitions[channel.topic, record.name] = record

    @property
    def corrected(self) -> frozenset[str]:
        """Topics whose stamps are moved."""
        return self._correction.topics & frozenset(self.topics())

    def shift_ns(self, message: RawMessage) -> int:
        """What must be added to the stamps of a message as it was recorded [ns]."""
        return self._correction.shift_ns(
            message.topic, message.publish_time_ns, message.log_time_ns
        )

    def messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield messages as ``Episode.messages`` does, with moved stamps."""
        for message in super().messages(topics, start_ns=start_ns, end_ns=end_ns):
            shift_ns = self.shift_ns(message)
            if shift_ns:
                definition = self._definitions.get((message.topic, message.type_name))
                yield restamped(message, definition, shift_ns)
            else:
                yield message


def open_episode(path: Path, *, clock: ClockChoice = "recorded") -> Episode:
    """Open an episode as ``Episode.open`` does, with the clock a person asked for."""
    episode = Episode.open(path)
    if clock == "recorded":
        return episode
    corrected = CorrectedEpisode(episode)
    if not corrected.corrected:
        raise EpisodeError(
            path=path,
            found=f"it holds no clock readings ({CLOCKS}), so that stamps cannot be corrected",
            hint="Read it with --clock recorded.",
        )
    return corrected
