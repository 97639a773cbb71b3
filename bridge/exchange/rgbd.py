"""Writes the messages of an RGB-D folder straight into a scan episode, without the wire."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bridge.episode.message import StampedMessage
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run import RunFolder, check_episode_id
from bridge.episode.writer import EpisodeWriter


def write_scan(
    run: RunFolder,
    info: EpisodeInfo,
    messages: Iterable[StampedMessage],
    *,
    source: dict[str, Any],
) -> Path:
    """Write one episode; on any error nothing with its final name is left.

    Args:
        run: Where the episode goes.
        info: Who and what it is.
        messages: In time order; log time is their source time.
        source: Where they come from and what was rounded; kept as metadata ``source``.
    """
    check_episode_id(info.id)
    writer = EpisodeWriter(run.episodes_dir / f"{info.id}.mcap")
    try:
        writer.describe(info)
        for message in messages:
            writer.write(
                message.topic,
                message.data,
                type_name=message.type_name,
                log_time_ns=message.stamp_ns,
            )
        writer.add_metadata("source", {name: json.dumps(v) for name, v in source.items()})
        return writer.close()
    except BaseException:
        writer.discard()
        raise
