"""Where the messages of an unpacked chunk lie: by its message index, as far as that is right.

Walking from record to record takes a microsecond each, and a chunk of joints and poses holds
thousands. The index behind the chunk says where they begin. It is only a hint: each record it names
is looked at, and with what lies between them they must fill the chunk. Where they do not, and where
there is no index, the chunk is walked through. Both ways give the same (tests compare them).
"""

import struct
from array import array
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64, UInt16, UInt64

from bridge.episode.mcap.format import (
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    RECORD_HEAD,
)
from bridge.episode.mcap.packed import records_in
from bridge.episode.mcap.walk import BrokenRecordError

_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel_id", "<u2"),
        ("sequence", "<u4"),
        ("log_time_ns", "<u8"),
        ("publish_time_ns", "<u8"),
    ]
)
"""``MESSAGE_HEAD`` in NumPy's words."""
_INDEX_HEAD = struct.Struct("<HI")
"""Channel, and bytes of the entries that follow."""
_ENTRY_BYTES = 16
NUM_CHANNEL_IDS = 1 << 16


class MessageTable(NamedTuple):
    """The messages of one chunk, in the order in which they lie there."""

    log_times_ns: UInt64[np.ndarray, " num_messages"]
    channel_ids: UInt16[np.ndarray, " num_messages"]
    starts: Int64[np.ndarray, " num_messages"]
    """Where each record begins in the chunk's data."""
    ends: Int64[np.ndarray, " num_messages"]
    """The first byte after it."""


def mask_of(channel_ids: Iterable[int]) -> Bool[np.ndarray, " num_channel_ids"]:
    """Return a mask over all channel ids there can be, true at these."""
    mask = np.zeros(NUM_CHANNEL_IDS, dtype=bool)
    mask[list(channel_ids)] = True
    return mask


def refuse_strays(
    channel_ids: UInt16[np.ndarray, " num_messages"],
    announced: Bool[np.ndarray, " num_channel_ids"],
) -> None:
    """Raise BrokenRecordError when a message is of a channel that was never announced."""
    is_known = announced[channel_ids]
    if not is_known.all():
        channel_id = int(channel_ids[int(np.argmin(is_known))])
        message = f"a message is of channel {channel_id}, which was never announced"
        raise BrokenRecordError(message)


def message_table(data: bytes, index: bytes) -> MessageTable:
    """List the messages in a chunk.

    Args:
        data: The chunk's records, unpacked.
        index: The message index records that follow the chunk; may be empty, or anything else.

    Raises:
        BrokenRecordError: When a record claims more bytes than are left, or is of kind 0.
    """
    table = by_index(data, index)
    return by_walk(data) if table is None else table


def by_walk(data: bytes) -> MessageTable:
    """List the messages in a chunk by going from record to record.

    Raises:
        BrokenRecordError: When a record claims more bytes than are left, or is of kind 0.
    """
    times_ns, channel_ids = array("Q"), array("H")
    starts, ends = array("q"), array("q")
    for opcode, at, length in records_in(data):
        if opcode == MESSAGE:
            _, _, channel_id, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(data, at)
            times_ns.append(log_time_ns)
            channel_ids.append(channel_id)
            starts.append(at)
            ends.append(at + RECORD_HEAD.size + length)
    return MessageTable(
        np.array(times_ns, dtype=np.uint64),
        np.array(channel_ids, dtype=np.uint16),
        np.array(starts, dtype=np.int64),
        np.array(ends, dtype=np.int64),
    )


def by_index(data: bytes, index: bytes) -> MessageTable | None:
    """List the messages in a chunk where its index says; None where it does not say all or wrong.

    Args:
        data: The chunk's records, unpacked.
        index: The message index records that follow the chunk.
    """
    listed = _entries(index)
    if listed is None:
        return None
    channel_ids, times_ns, offsets = listed
    if int(offsets.max()) > len(data) - MESSAGE_HEAD.size:
        return None
    order = np.argsort(offsets, kind="stable")
    starts = offsets[order].astype(np.int64)
    anywhere = np.ndarray(len(data) - _HEAD.itemsize + 1, dtype=_HEAD, buffer=data, strides=(1,))
    heads = anywhere[starts]
    lengths = heads["length"]
    is_right = (
        (heads["opcode"] == MESSAGE)
        & (lengths >= MESSAGE_FIELDS)
        & (lengths <= (len(data) - RECORD_HEAD.size - starts).astype(np.uint64))
        & (heads["channel_id"] == channel_ids[order])
        & (heads["log_time_ns"] == times_ns[order])
    )
    if not is_right.all():
        return None
    ends = starts + RECORD_HEAD.size + lengths.astype(np.int64)
    if not _fill(data, starts, ends):
        return None
    return MessageTable(times_ns[order], channel_ids[order], starts, ends)


def _entries(
    index: bytes,
) -> (
    tuple[
        UInt16[np.ndarray, " num_messages"],
        UInt64[np.ndarray, " num_messages"],
        UInt64[np.ndarray, " num_messages"],
    ]
    | None
):
    """Return channel, log time and offset of each entry; None where these are no such records."""
    channels, pairs, at = list[int](), [], 0
    while at < len(index):
        body = at + RECORD_HEAD.size
        if len(index) - body < _INDEX_HEAD.size:
            return None
        opcode, length = RECORD_HEAD.unpack_from(index, at)
        channel_id, size = _INDEX_HEAD.unpack_from(index, body)
        at = body + length
        is_right = opcode == MESSAGE_INDEX and size == length - _INDEX_HEAD.size
        if not is_right or size % _ENTRY_BYTES or at > len(index):
            return None
        found = np.frombuffer(index, "<u8", size // 8, body + _INDEX_HEAD.size)
        channels.append(channel_id)
        pairs.append(found.reshape(-1, 2))
    counts = [len(found) for found in pairs]
    if not sum(counts):
        return None
    every = np.concatenate(pairs)
    return np.repeat(np.array(channels, dtype=np.uint16), counts), every[:, 0], every[:, 1]


def _fill(
    data: bytes,
    starts: Int64[np.ndarray, " num_messages"],
    ends: Int64[np.ndarray, " num_messages"],
) -> bool:
    """Whether messages and the other whole records between them fill a chunk."""
    froms = np.concatenate([np.zeros(1, dtype=np.int64), ends])
    tos = np.append(starts, len(data))
    if (froms > tos).any():
        return False
    for gap in np.flatnonzero(froms < tos).tolist():
        try:
            kinds = [opcode for opcode, _, _ in records_in(data[froms[gap] : tos[gap]])]
        except BrokenRecordError:
            return False
        if MESSAGE in kinds:
            return False
    return True
