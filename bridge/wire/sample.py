"""A message as it arrived, copied out of the network's own memory at once."""

import hashlib
import sys
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from bridge.wire import attachment, keys


@dataclass(frozen=True, kw_only=True, slots=True)
class WireSample:
    """One message as it arrived."""

    topic: str
    type_name: str
    """"" when the publisher did not say."""
    message_encoding: str
    """cdr, json or ""."""
    type_hash: str = ""
    """RIHS01 hash of the ROS 2 definition the publisher was built with; "" when it did not say."""
    data: bytes
    source_ns: int | None
    """When the publisher says it made the message."""
    sequence: int | None
    """Counts the publisher's messages; None when they are not numbered."""
    source_gid: bytes | None
    """16 bytes that no other publisher has."""
    received_ns: int
    oversize_bytes: int = 0
    """Size of a payload beyond the subscription's limit; then ``data`` is empty, not a copy."""


def copy_sample(sample: Any, received_ns: int, *, max_bytes: int = sys.maxsize) -> WireSample:
    """Read a zenoh sample. Its payload is copied: a kept one would pin the sender's memory."""
    size = len(sample.payload)
    is_oversize = size > max_bytes
    named = keys.read_key(str(sample.key_expr))
    type_name, message_encoding = keys.parse_encoding(str(sample.encoding))
    raw = sample.attachment
    note = attachment.decode(None if raw is None else raw.to_bytes())
    if note is None:
        sequence, gid = _source_of(sample.source_info)
        source_ns = None
    else:
        sequence, gid, source_ns = note.sequence, note.gid, note.source_ns
    return WireSample(
        topic=named.topic,
        type_name=type_name or named.type_name,
        message_encoding=message_encoding or ("cdr" if named.type_name else ""),
        type_hash=named.type_hash,
        data=b"" if is_oversize else sample.payload.to_bytes(),
        source_ns=source_ns,
        sequence=sequence,
        source_gid=gid,
        received_ns=received_ns,
        oversize_bytes=size if is_oversize else 0,
    )


def _source_of(info: Any) -> tuple[int | None, bytes | None]:
    """Number and publisher of a sample that zenoh itself numbered (an AdvancedPublisher does)."""
    if info is None:
        return None, None
    source = info.source_id
    return int(info.source_sn), _gid(str(source.zid), int(source.eid))


@lru_cache(maxsize=4096)
def _gid(session: str, entity: int) -> bytes:
    name = f"{session}/{entity}".encode()
    return hashlib.blake2b(name, digest_size=attachment.GID_BYTES).digest()
