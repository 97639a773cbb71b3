"""Space held back on the disk, so that an episode can be finished when everything else is full."""

import contextlib
import errno
import os
import tempfile
from pathlib import Path

from bridge.record.config import BYTES_PER_MB
from bridge.record.errors import NoSpaceError


class FooterReserve:
    """An allocated file without a name: it vanishes with the process, whatever ends it."""

    def __init__(self, folder: Path, size_mb: int) -> None:
        """Choose where and how much; nothing is allocated yet."""
        self._folder = folder
        self._bytes = size_mb * BYTES_PER_MB
        self._descriptor: int | None = None

    def hold(self) -> None:
        """Allocate it, if it is not yet.

        Raises:
            NoSpaceError: When the disk has not that much left.
        """
        if self._descriptor is not None or not self._bytes:
            return
        try:
            descriptor = _nameless(self._folder)
        except OSError:  # the folder cannot be written: creating the episode says so better
            return
        try:
            os.posix_fallocate(descriptor, 0, self._bytes)
        except OSError as error:
            os.close(descriptor)
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise NoSpaceError(
                    folder=self._folder, free_mb=0, wanted_mb=self._bytes // BYTES_PER_MB
                ) from error
            return  # a file system or a limit that allows none: record without
        self._descriptor = descriptor

    def release(self) -> None:
        """Give the space back to the disk."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _nameless(folder: Path) -> int:
    if hasattr(os, "O_TMPFILE"):
        with contextlib.suppress(OSError):  # some file systems have no such files
            return os.open(folder, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
    descriptor, name = tempfile.mkstemp(prefix=".reserve-", dir=folder)
    Path(name).unlink()
    return descriptor


def free_bytes(folder: Path) -> int:
    """What an ordinary user may still write there."""
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize
