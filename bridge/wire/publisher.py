"""Sending one topic, with an attachment to each message.

The attachment's bytes are those of rmw_zenoh, so that native and ROS 2 publishers look alike: int64
sequence, int64 source time [ns], length 16 and a 16-byte publisher id, little endian, 33 bytes.
"""

import contextlib
import struct
import uuid
from dataclasses import dataclass
from typing import Any

from bridge.wire.errors import WireError, cause_of
from bridge.wire.zenoh_config import zenoh

GID_BYTES = 16
_PLAIN = struct.Struct("<qqB16s")


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
    """Read the 33-byte form; anything else is no attachment."""
    if data is None or len(data) != _PLAIN.size:
        return None
    sequence, source_ns, length, gid = _PLAIN.unpack(data)
    if length != GID_BYTES:
        return None
    return Attachment(sequence=sequence, source_ns=source_ns, gid=gid)


BYTES_PER_MB = 1_000_000


class WirePublisher:
    """Sends one topic, numbering its messages."""

    def __init__(self, inner: Any) -> None:
        """Use ``WireSession.publisher``."""
        self._inner = inner
        self._sequence = 0
        self.sent = 0
        """Numbers used and handed to the network: whoever hears of them hears it behind them."""
        self.gid = uuid.uuid4().bytes

    def put(self, data: bytes | bytearray, *, source_ns: int) -> None:
        """Send one serialised message made at ``source_ns``."""
        note = Attachment(sequence=self._sequence, source_ns=source_ns, gid=self.gid)
        self._sequence += 1
        try:
            self._inner.put(data, attachment=encode(note))
        except zenoh.ZError as error:
            raise WireError(f"cannot publish: {cause_of(error)}. Is the session open?") from error
        finally:
            self.sent += 1

    def skip(self, count: int) -> None:
        """Leave out numbers: messages that were lost before they got here, on the device's side.

        Receivers count them as they count any other gap.
        """
        self._sequence += count
        self.sent += count

    def has_subscribers(self) -> bool:
        """Say whether anybody would get a message; costly ones need not be made otherwise."""
        try:
            return bool(self._inner.matching_status.matching)
        except zenoh.ZError:  # the session is closed
            return False

    def close(self) -> None:
        """Stop publishing."""
        with contextlib.suppress(zenoh.ZError):
            self._inner.undeclare()
