"""Gather the payloads of whole topics at once, in the order in which ``merge`` yields them.

A message that passes through as an object of its own costs three microseconds, and a motion has
thousands. What is wanted of a chunk is cut out of it in one go; the chunk is then forgotten.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt64

from bridge.episode.mcap.file import McapFile, damaged
from bridge.episode.mcap.format import MESSAGE_HEAD
from bridge.episode.mcap.merge import Selection, may_hold, merged, read_chunk
from bridge.episode.mcap.table import mask_of, refuse_strays
from bridge.episode.mcap.walk import DAMAGE

Group = frozenset[str]
"""Topics whose messages are wanted together."""


class _Gathered:
    """The payloads of one group, as they come."""

    def __init__(self, topics: Group) -> None:
        self.topics = topics
        self._payloads: list[bytes] = []
        self._times_ns: list[UInt64[np.ndarray, " num_messages"]] = []

    def add(self, payloads: Sequence[bytes], times_ns: UInt64[np.ndarray, " num_messages"]) -> None:
        self._payloads += payloads
        self._times_ns.append(times_ns)

    def in_log_order(self) -> list[bytes]:
        if not self._payloads:
            return []
        times_ns = np.concatenate(self._times_ns)
        if (times_ns[1:] >= times_ns[:-1]).all():
            return self._payloads
        return [self._payloads[at] for at in np.argsort(times_ns, kind="stable").tolist()]


def gathered(files: Sequence[McapFile], groups: Sequence[Group]) -> list[list[bytes]]:
    """Return the payloads of each group: by log time, then by file, then by place in the file.

    Args:
        files: Parts of one episode.
        groups: A topic may be in several.

    Raises:
        EpisodeError: When a file is damaged or cannot be read.
    """
    every = frozenset().union(*groups) if groups else frozenset[str]()
    if any(_has_loose(file) for file in files):
        return _one_by_one(files, groups, every)
    found = [_Gathered(topics) for topics in groups]
    for file in files:
        try:
            _gather(file, found, every)
        except DAMAGE as error:
            raise damaged(file.path, error) from error
    return [group.in_log_order() for group in found]


def _has_loose(file: McapFile) -> bool:
    try:
        return len(file.loose().offsets) > 0
    except DAMAGE as error:
        raise damaged(file.path, error) from error


def _one_by_one(
    files: Sequence[McapFile], groups: Sequence[Group], every: frozenset[str]
) -> list[list[bytes]]:
    found: list[list[bytes]] = [[] for _ in groups]
    for item in merged(files, Selection(topics=every)):
        for topics, payloads in zip(groups, found, strict=True):
            if item.channel.topic in topics:
                payloads.append(item.data)
    return found


def _gather(file: McapFile, found: Sequence[_Gathered], every: frozenset[str]) -> None:
    channels = file.summary.channels
    wanted = {channel_id for channel_id, channel in channels.items() if channel.topic in every}
    chunks = [index for index in file.summary.chunk_indexes if may_hold(index, wanted)]
    if not wanted or not chunks:
        return
    announced = mask_of(channels)
    chosen = [mask_of(c for c in wanted if channels[c].topic in group.topics) for group in found]
    with file.path.open("rb") as stream:
        for index in sorted(chunks, key=lambda index: index.chunk_start_offset):
            data, table = read_chunk(stream, index, file.data_end)
            refuse_strays(table.channel_ids, announced)
            for group, wanted_ids in zip(found, chosen, strict=True):
                mask = wanted_ids[table.channel_ids]
                firsts = (table.starts[mask] + MESSAGE_HEAD.size).tolist()
                spans = zip(firsts, table.ends[mask].tolist(), strict=True)
                payloads = [data[first:last] for first, last in spans]
                group.add(payloads, table.log_times_ns[mask])
