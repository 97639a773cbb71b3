"""The ``.part`` file of an episode while it grows: locked, never torn, renamed when whole.

The exclusive ``flock`` is how recovery tells a file that is being written from one whose writer
died: the kernel drops the lock with the process.
"""

import contextlib
import errno
import fcntl
import os
import threading
from collections.abc import Sequence
from pathlib import Path

from bridge.episode.mcap.format import Buffer, crc32, num_bytes
from bridge.errors import BridgeError, UsageError

MAX_PIECES = 1024
"""Buffers the kernel takes in one call (IOV_MAX on Linux)."""


class PartFile:
    """An open file that only grows by whole records."""

    def __init__(self, path: Path, descriptor: int, *, offset: int = 0, crc: int = 0) -> None:
        """Continue a locked file at ``offset``; ``crc`` is the CRC-32 of everything before it."""
        self.path = path
        self.offset = offset
        self.crc = crc
        self.failed: OSError | None = None
        """Why nothing after it can be trusted to be on the disk."""
        self._descriptor = descriptor

    @staticmethod
    def create(path: Path) -> "PartFile":
        """Create and lock a new file."""
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            raise
        return PartFile(path, descriptor)

    def append(self, buffers: Sequence[Buffer]) -> None:
        """Write one record or several, all or nothing.

        Raises:
            OSError: When the disk refused, or somebody cut the file; it ends where it ended before.
        """
        if os.fstat(self._descriptor).st_size < self.offset:
            raise OSError(errno.ENOENT, f"{self.path} was cut while it was written")
        offset = self.offset
        try:
            for first in range(0, len(buffers), MAX_PIECES):
                offset = self._write_all(buffers[first : first + MAX_PIECES], offset)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self.offset)
            raise
        for piece in buffers:
            self.crc = crc32(piece, self.crc)
        self.offset = offset

    def _write_all(self, buffers: Sequence[Buffer], offset: int) -> int:
        end = offset + sum(map(num_bytes, buffers))
        offset += os.pwritev(self._descriptor, buffers, offset)
        if offset < end:  # a full disk or a limit took a part; the next try says why
            rest = memoryview(b"".join(buffers))[offset - end :]
            while rest:
                written = os.pwritev(self._descriptor, [rest], offset)
                offset += written
                rest = rest[written:]
        return offset

    def sync_data(self) -> None:
        """Force what was written to the disk; safe from another thread.

        Raises:
            OSError: Kept in ``failed`` too. The kernel forgets which pages it could not write, so
                a later sync that succeeds would prove nothing.
        """
        try:
            os.fdatasync(self._descriptor)
        except OSError as error:
            self.failed = error
            raise

    def publish(self, final_path: Path) -> None:
        """Sync the file and give it its final name; it stays open and locked until ``close``.

        Raises:
            OSError: When the disk refused, or another file has its name; nothing is renamed.
        """
        self.sync_data()
        self.refuse_removed()
        self.path.rename(final_path)
        sync_folder(final_path.parent)

    def truncate(self, offset: int, crc: int) -> None:
        """Drop everything from ``offset`` on; ``crc`` is that of what stays."""
        os.ftruncate(self._descriptor, offset)
        self.offset, self.crc = offset, crc

    def refuse_removed(self) -> None:
        """Raise OSError where the file lost its name: somebody removed or replaced it."""
        try:
            is_there = os.path.samestat(os.fstat(self._descriptor), self.path.stat())
        except (FileNotFoundError, NotADirectoryError):
            is_there = False
        if not is_there:
            raise OSError(errno.ENOENT, f"{self.path} was removed or replaced while it was written")

    def close(self) -> None:
        """Close and unlock; safe to repeat."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


class BackgroundSync:
    """Syncs a file each period in a thread of its own, so that the writer never waits for it.

    A failure is left in the file's ``failed``, and ends the thread.
    """

    def __init__(self, file: PartFile, period_s: float) -> None:
        """Start the thread."""
        self._file = file
        self._period_s = period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="episode sync", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        synced = 0
        while not self._stop.wait(self._period_s):
            offset = self._file.offset
            if offset == synced:
                continue
            try:
                self._file.sync_data()
            except OSError:
                return
            synced = offset

    def stop(self) -> None:
        """End the thread, after a sync under way."""
        self._stop.set()
        self._thread.join()


def open_part(path: Path, *, replace_dead: bool) -> PartFile:
    """Create ``<path>.part``, locked, for an episode that is not there yet."""
    part_path = path.with_name(path.name + ".part")
    if path.exists():
        raise _exists(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(part_path, error) from error
    try:
        if replace_dead:
            _remove_dead(part_path)
        file = PartFile.create(part_path)
    except (FileExistsError, BlockingIOError) as error:
        raise UsageError(
            f"{part_path} exists: another writer has it open, or died. "
            "Choose another name; robot-gst recover finishes what a dead writer left."
        ) from error
    except OSError as error:
        raise cannot_write(part_path, error) from error
    if path.exists():  # another writer finished it between the two looks
        part_path.unlink(missing_ok=True)
        file.close()
        raise _exists(path)
    return file


def _remove_dead(part_path: Path) -> None:
    with contextlib.suppress(FileNotFoundError):
        descriptor = lock_dead(part_path)
        if descriptor is not None:
            part_path.unlink()
            os.close(descriptor)


def _exists(path: Path) -> UsageError:
    return UsageError(f"{path} exists already. Choose another name, or move it away.")


def cannot_write(path: Path, error: OSError) -> BridgeError:
    """Make the sentence for a file that could not be created."""
    return BridgeError(f"cannot write {path}: {error.strerror}. Choose another folder.")


def lock_dead(path: Path, *, write: bool = True) -> int | None:
    """Open and lock a file whose writer is gone; None when it is still being written."""
    descriptor = os.open(path, (os.O_RDWR if write else os.O_RDONLY) | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Its writer may have finished and renamed it between the two calls.
        if os.path.samestat(os.fstat(descriptor), path.stat()):
            return descriptor
    except (BlockingIOError, FileNotFoundError):
        pass
    except BaseException:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


def told_unfinished(path: Path) -> tuple[str, bool]:
    """Name a file that is not finished and what to do, and say whether its writer is alive."""
    descriptor = lock_dead(path, write=False)
    if descriptor is None:
        return f"{path} is being written", True
    os.close(descriptor)
    return f"{path} is not finished: its writer was killed; robot-gst recover {path}", False


def sync_folder(folder: Path) -> None:
    """Make a new name in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
