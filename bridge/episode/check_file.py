"""Walk through one MCAP file from front to back and compare everything it says of itself.

Summary and index are not believed; they are compared with what a walk finds.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap import records
from mcap.summary import Summary

from bridge.episode.mcap.damaged import RecordFile
from bridge.episode.mcap.data_walk import DataWalk, ScannedMessage
from bridge.episode.mcap.format import FileSummary
from bridge.episode.mcap.walk import DAMAGE, read_footer, read_header, read_summary


def summary_faults(seen: FileSummary, summary: Summary | None) -> Iterator[str]:
    """Yield a sentence for every place where summary and data disagree.

    What a writer may leave out (statistics, repeated records, an index as a whole) is no fault.
    """
    if summary is None:
        return
    in_data = len(seen.schemas), len(seen.channels)
    # Topics nobody spoke on may stand in the summary only, counted or not (libmcap 1.1).
    for schema in summary.schemas.values():
        if seen.schemas.setdefault(schema.id, schema) != schema:
            yield f"the summary's schema {schema.id} ({schema.name}) is not that of the data"
    for channel in summary.channels.values():
        if seen.channels.setdefault(channel.id, channel) != channel:
            yield f"the summary's channel {channel.id} ({channel.topic}) is not that of the data"
    if summary.statistics is not None:
        yield from _statistics_faults(seen, summary.statistics, *in_data)
    for what in ("chunk", "attachment", "metadata"):
        said, found = (getattr(each, f"{what}_indexes") for each in (summary, seen))
        key = "chunk_start_offset" if what == "chunk" else "offset"
        yield from _index_faults(what, said, found, key)


def _statistics_faults(
    seen: FileSummary, said: records.Statistics, num_schemas: int, num_channels: int
) -> Iterator[str]:
    pairs = {
        "messages": (said.message_count, sum(seen.message_counts.values())),
        "schemas": (said.schema_count, _either(said.schema_count, seen.schemas, num_schemas)),
        "channels": (said.channel_count, _either(said.channel_count, seen.channels, num_channels)),
        "attachments": (said.attachment_count, len(seen.attachment_indexes)),
        "metadata records": (said.metadata_count, len(seen.metadata_indexes)),
        "chunks": (said.chunk_count, len(seen.chunk_indexes)),
    }
    for what, (count, found) in pairs.items():
        if count != found:
            yield f"the summary says {count} {what}, {found} were read"
    times = (said.message_start_time, said.message_end_time)
    # Log time 0 means "none yet" to the Go writer, which then states the next one.
    start_ns = said.message_start_time if seen.start_ns == 0 else seen.start_ns
    if seen.message_counts and times != (start_ns, seen.end_ns):
        yield f"the summary says messages from {times}, they are from {(start_ns, seen.end_ns)}"
    for channel_id in sorted(said.channel_message_counts.keys() | seen.message_counts.keys()):
        count = said.channel_message_counts.get(channel_id, 0)
        found = seen.message_counts.get(channel_id, 0)
        if count != found and said.channel_message_counts:
            channel = seen.channels.get(channel_id)
            name = channel.topic if channel else f"channel {channel_id}"
            yield f"{name}: the summary says {count} messages, {found} were read"


def _either(said: int, everywhere: Collection[int], in_data: int) -> int:
    """Return the count that agrees, if one does."""
    return in_data if said == in_data else len(everywhere)


def _index_faults(what: str, said: list, found: list, key: str) -> Iterator[str]:  # type: ignore[type-arg]
    if not said:
        return  # a file without this index
    there = {getattr(entry, key): entry for entry in found}
    for entry in said:
        at = getattr(entry, key)
        other = there.pop(at, None)
        if other is None:
            yield f"the {what} index points at byte {at}, where none lies"
        elif other != entry:
            names = [n for n in vars(entry) if getattr(entry, n) != getattr(other, n)]
            yield f"the {what} index of byte {at} is wrong about {', '.join(names)}"
    for at in there:
        yield f"the {what} at byte {at} is not in the index"


LISTED = 20


@dataclass
class Faults:
    """The first faults of a file; a damaged one could have millions."""

    listed: list[str] = field(default_factory=list)
    count: int = 0

    def add(self, text: str) -> None:
        """Take one more."""
        self.count += 1
        if len(self.listed) < LISTED:
            self.listed.append(text)


def checked_messages(path: Path, faults: Faults) -> Iterator[ScannedMessage]:
    """Yield every message that can be read, in file order; damage is listed, not raised."""

    def fault(text: str) -> None:
        faults.add(f"{path.name}: {text}")

    try:
        with path.open("rb") as stream:
            read_header(stream)
            footer, footer_at = read_footer(stream)
            file = RecordFile(stream, footer.summary_start or footer_at)
            data = DataWalk(file, fault=fault, doubt=fault)
            yield from data.messages()
            for text in summary_faults(data.seen, read_summary(stream, footer, footer_at)):
                fault(text)
    except DAMAGE as error:
        fault(f"damaged: {error}" if str(error) else f"damaged ({type(error).__name__})")
