"""The attachment each message carries: sequence number, source time and publisher identity.

The bytes are those of rmw_zenoh, so that native and ROS 2 publishers look alike:
int64 sequence, int64 source time [ns], length 16 and a 16-byte publisher id, little endian,
33 bytes. ROS 2 Jazzy's first releases put each field's name before it (77 bytes); both are read.
"""

import struct
from dataclasses import dataclass

GID_BYTES = 16
_PLAIN = struct.Struct("<qqB16s")
_NAMED = struct.Struct("<B15sqB16sqB10sB16s")
_NAMES = (b"sequence_number", b"source_timestamp", b"source_gid")


@dataclass(frozen=True, kw_only=True)
class Attachment:
    """Who sent a message, when, and which in a row it is."""

    sequence: int
    source_ns: int
    gid: bytes
    """16 bytes that no other publisher has."""


def encode(attachment: Attachment) -> bytes:
    """Serialise in the 33-byte form."""
    return _PLAIN.pack(attachment.sequence, attachment.source_ns, GID_BYTES, attachment.gid)


def decode(data: bytes | None) -> Attachment | None:
    """Read the 33-byte or the 77-byte form; anything else is no attachment."""
    if data is None:
        return None
    if len(data) == _PLAIN.size:
        sequence, source_ns, length, gid = _PLAIN.unpack(data)
        if length != GID_BYTES:
            return None
    elif len(data) == _NAMED.size:
        fields = _NAMED.unpack(data)
        _, sequence_name, sequence, _, time_name, source_ns, _, gid_name, length, gid = fields
        if (sequence_name, time_name, gid_name) != _NAMES or length != GID_BYTES:
            return None
    else:
        return None
    return Attachment(sequence=sequence, source_ns=source_ns, gid=gid)
