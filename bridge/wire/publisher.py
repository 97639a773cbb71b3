"""Sending one topic, through shared memory where that is on, with an attachment to each message.

The attachment's bytes are those of rmw_zenoh, so that native and ROS 2 publishers look alike: int64
sequence, int64 source time [ns], length 16 and a 16-byte publisher id, little endian, 33 bytes.
"""

import contextlib
import shutil
import struct
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.wire.errors import WireConfigError, WireError, cause_of
from bridge.wire.zenoh_config import zenoh, zenoh_shm

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
SHARED_FROM_BYTES = 3072
"""Smaller messages are cheaper to send than to place; zenoh's own optimisation says the same."""
_MEMORY = Path("/dev/shm")  # where Linux keeps it; nothing is opened by this name


class SharedPool:
    """Memory that receivers on this machine read without a copy through the network."""

    def __init__(self, num_bytes: int) -> None:
        """Reserve the pool."""
        free = _free_bytes()
        if free is not None and free < num_bytes:
            problem = f"{_MEMORY} has {free / BYTES_PER_MB:.0f} MB left"
        else:
            problem = ""
            try:
                self._pool = zenoh_shm.ShmProvider.default_backend(num_bytes)
            except zenoh.ZError as error:
                problem = cause_of(error)
        if problem:
            raise WireConfigError(
                f"{num_bytes / BYTES_PER_MB:.0f} MB of shared memory are not to be had: {problem}. "
                "Ask for less, or pass 0 to send images over the network."
            )
        # Never BlockOn: a receiver that hangs keeps its buffers, and the sender must not hang too.
        self._policy = zenoh_shm.Defragment(zenoh_shm.GarbageCollect())

    def place(self, data: bytes | bytearray) -> Any | None:
        """Copy a message into the pool; None when there is no space now."""
        try:
            buffer = self._pool.alloc(len(data), self._policy)
        except zenoh.ZError:
            return None
        buffer[0 : len(data)] = data
        return buffer


def _free_bytes() -> int | None:
    return shutil.disk_usage(_MEMORY).free if _MEMORY.is_dir() else None


class WirePublisher:
    """Sends one topic, numbering its messages."""

    def __init__(self, inner: Any, pool: SharedPool | None = None) -> None:
        """Use ``WireSession.publisher``."""
        self._inner = inner
        self._pool = pool
        self._sequence = 0
        self.sent = 0
        """Numbers used and handed to the network: whoever hears of them hears it behind them."""
        self.gid = uuid.uuid4().bytes
        self.not_shared = 0
        """Messages that found the shared memory full and went over the network instead."""

    def put(self, data: bytes | bytearray, *, source_ns: int) -> None:
        """Send one serialised message made at ``source_ns``."""
        note = Attachment(sequence=self._sequence, source_ns=source_ns, gid=self.gid)
        self._sequence += 1
        payload: Any = data
        if self._pool is not None and len(data) >= SHARED_FROM_BYTES:
            placed = self._pool.place(data)
            if placed is None:
                self.not_shared += 1
            else:
                payload = placed
        try:
            self._inner.put(payload, attachment=encode(note))
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
