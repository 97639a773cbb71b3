"""What was found whole, what was lost, and why: counted while a broken file is read."""

from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Attachment, Channel, DataEnd, Header, McapRecord, Metadata, Schema

from bridge.episode import provenance
from bridge.episode.mcap.damaged import RecordFile, summary_definitions
from bridge.episode.mcap.scan import Chunk, Damage, Found, IndexSpan, Plain, TopMessage
from bridge.episode.metadata import from_strings, to_strings

RECORD_NAME = "recovered"
MAX_REASONS = 8


@dataclass(frozen=True, kw_only=True)
class RecoveryReport:
    """What recovery did with one file."""

    path: Path
    output: Path | None
    """The finished episode; None when nothing could be read."""
    messages: int = 0
    topics: dict[str, int] = field(default_factory=dict)
    bytes_lost: int = 0
    """Bytes of the file that hold no whole record; what never reached the disk is not known."""
    reason: str = ""
    finished: bool = False
    attachments: int = 0
    original: Path | None = None
    """Where a part that is damaged inside was kept, for someone who can read more of it."""


@dataclass(kw_only=True)
class RecoveryTally:
    """Counts while a file is being read."""

    messages: dict[int, int] = field(default_factory=dict)
    header: Header | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    """The first definition of each id."""
    attachments: int = 0
    bytes_lost: int = 0
    losses: list[str] = field(default_factory=list)
    has_data: bool = False
    reached_end: int | None = None
    """Where the writer ended the data, if it did."""
    earlier: dict[str, object] = field(default_factory=dict)
    """What a recovery before this one wrote into the file."""
    damaged_inside: bool = False

    def take(self, found: Found) -> None:
        """Count one thing found in the file."""
        match found:
            case Damage():
                self.bytes_lost += found.length
                self.damaged_inside |= not found.at_end
                self.losses.append(found.what)
                return
            case Plain(record=DataEnd()):
                self.reached_end = found.offset
                return
            case IndexSpan():
                return
            case Chunk():
                self._define(found.contents.definitions)
                for channel_id, entries in found.contents.index.items():
                    self._add(channel_id, len(entries) // 2)
            case TopMessage():
                self._add(found.channel_id, 1)
            case Plain():
                self._take_plain(found)
        self.has_data = True

    def _take_plain(self, found: Plain) -> None:
        match found.record:
            case Header() as header:
                self.header = self.header or header
            case Schema() | Channel():
                self._define([found.record])
            case Attachment():
                self.attachments += 1
            case Metadata(name=name, metadata=values) if name == RECORD_NAME:
                self.earlier = from_strings(values)

    def _add(self, channel_id: int, count: int) -> None:
        self.messages[channel_id] = self.messages.get(channel_id, 0) + count

    def _define(self, definitions: list[McapRecord | None]) -> None:
        for record in definitions:
            if isinstance(record, Schema):
                self.schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                self.channels.setdefault(record.id, record)

    def complete(self, source: RecordFile) -> None:
        """Find what was lost of the definitions in the summary, or make it: readers need them."""
        self._define(summary_definitions(source))
        for number in self.messages:
            self.channels.setdefault(number, Channel(number, unknown_topic(number), "", {}, 0))
        for number in {channel.schema_id for channel in self.channels.values()} - {0}:
            self.schemas.setdefault(number, Schema(number, b"", "", "unknown"))

    @property
    def reason(self) -> str:
        """Why the file had to be recovered, and what was lost, in one line."""
        before = self.earlier.get("reason")
        parts = [str(before)] if before else []
        if self.reached_end is None:
            parts.append("its writer did not finish it")
        elif not self.losses and not before:
            parts.append("its closing part was missing or wrong")
        parts += self.losses[:MAX_REASONS]
        if len(self.losses) > MAX_REASONS:
            parts.append(f"and {len(self.losses) - MAX_REASONS} more places")
        return "; ".join(parts)

    def report(self, path: Path, output: Path | None, *, finished: bool) -> RecoveryReport:
        """Say what was done with a file."""
        counts: dict[str, int] = {}
        for channel_id, count in self.messages.items():
            channel = self.channels.get(channel_id)
            topic = channel.topic if channel else unknown_topic(channel_id)
            counts[topic] = counts.get(topic, 0) + count
        before = self.earlier.get("bytes_lost")
        return RecoveryReport(
            path=path,
            output=output,
            messages=sum(counts.values()),
            topics=dict(sorted(counts.items())),
            bytes_lost=self.bytes_lost + (before if isinstance(before, int) else 0),
            reason=str(self.earlier.get("reason", "")) if finished else self.reason,
            finished=finished,
            attachments=self.attachments,
        )


def to_metadata(report: RecoveryReport) -> dict[str, str]:
    """Return the ``recovered`` metadata record of an episode; every value is JSON."""
    values = {name: getattr(report, name) for name in ("reason", "bytes_lost", "messages")}
    return to_strings({**values, "tool": provenance.software()})


def unknown_topic(channel_id: int) -> str:
    """Name a channel whose definition was lost."""
    return f"/recovered/channel_{channel_id}"
