"""An episode written anew with the clocks of its sources taken out of all stamps.

For readers that know nothing of clocks: ``rebuild``, ``replay``, ``evaluate``, other programs. The
readings are left out of the copy, so that nothing is corrected twice.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bridge.episode.clocks import CorrectedEpisode, clocks_of, open_episode, restamped
from bridge.episode.mcap.messages import Selection, merged
from bridge.episode.provenance import hash_files
from bridge.episode.reader import RawMessage
from bridge.episode.schema import Schema
from bridge.episode.topics import CLOCKS
from bridge.episode.writer import EpisodeWriter
from bridge.errors import EpisodeError
from bridge.terminal import Advance

RECORD = "clock_correction"
"""Metadata record of the copy: where it comes from, and the lines that were taken out."""


def write_corrected(path: Path, out: Path, *, advance: Advance) -> dict[str, int]:
    """Write the copy.

    Args:
        path: A finished episode, the first part of a split one; its parts become one file.
        out: The file to make; an episode that is there is not replaced.
        advance: Told how many messages are done.

    Returns:
        Messages by topic whose stamps were moved.

    Raises:
        EpisodeError: When nobody measured the clocks, a part is missing, or the file is damaged.
        UsageError: When ``out`` exists.
    """
    episode = open_episode(path, clock="corrected")
    assert isinstance(episode, CorrectedEpisode)  # noqa: S101  # asked for
    if episode.missing_parts:
        names = ", ".join(each.name for each in episode.missing_parts)
        raise EpisodeError(path=path, found=f"{names} is missing", hint="Bring the parts together.")
    moved: dict[str, int] = {}
    writer = EpisodeWriter(out)
    try:
        for done, item in enumerate(merged(episode.files, Selection()), start=1):
            topic = item.channel.topic
            if topic == CLOCKS:
                continue
            record = item.file.schema_of(item.channel)
            message = RawMessage(
                topic,
                record.name if record else "",
                item.log_time_ns,
                item.publish_time_ns,
                item.sequence,
                item.data,
            )
            shift_ns = episode.shift_ns(message)
            if shift_ns:
                message = restamped(message, record, shift_ns)
                moved[topic] = moved.get(topic, 0) + 1
            encoding = item.channel.message_encoding
            writer.write_foreign(
                topic,
                message.data,
                schema_record=None
                if record is None
                else Schema(
                    name=record.name,
                    schema_encoding=record.encoding,
                    message_encoding=encoding,
                    data=record.data,
                ),
                message_encoding=encoding,
                log_time_ns=message.log_time_ns,
                publish_time_ns=message.publish_time_ns,
                sequence=message.sequence,
                about=tuple(item.channel.metadata.items()),
            )
            advance(done, "")
        _copy_records(episode, writer)
        writer.close()
    except BaseException:
        writer.discard()
        raise
    return dict(sorted(moved.items()))


def _copy_records(episode: CorrectedEpisode, writer: EpisodeWriter) -> None:
    for name, values in episode.texts.items():
        if name != "split":  # one file now
            writer.add_metadata(name, values)
    clocks = clocks_of(episode)
    about: dict[str, Any] = {
        "source_episode": episode.path.name,
        "source_sha256": hash_files(episode.parts),
        "clocks": [
            {"source": c.source, "host": c.host, "lines": [asdict(line) for line in c.lines()]}
            for c in clocks
        ],
    }
    writer.add_metadata(RECORD, {name: json.dumps(value) for name, value in about.items()})
    seen: set[str] = set()
    for file in episode.files:
        for found in file.attachments():
            if found.name not in seen:  # every part of a split episode has them
                seen.add(found.name)
                writer.attach(
                    found.name,
                    bytes(found.data),
                    media_type=found.media_type,
                    log_time_ns=found.log_time,
                )
