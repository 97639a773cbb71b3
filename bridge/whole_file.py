"""Write files and folders whole or not at all: the final name appears when all is there."""

import ctypes
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def part_of(path: Path) -> Path:
    """Name the file that is written first: its own for each process, for two may write at once."""
    return path.with_name(f"{path.name}.{os.getpid()}.part")


def write_whole(path: Path, data: bytes) -> None:
    """Write the part, sync it to disk, and give it its final name; what fails leaves nothing."""
    part = part_of(path)
    try:
        with part.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError):  # a full disk does not say where
            error.filename = str(path)
        raise


@contextmanager
def beside(folder: Path, part: Path) -> Iterator[None]:
    """Copy a folder; the copy takes its place when the block ended well. Readers have the old."""
    shutil.rmtree(part, ignore_errors=True)  # of one that was killed
    try:
        shutil.copytree(folder, part)
        yield
        rename = getattr(ctypes.CDLL(None), "renameat2", None)  # -100: AT_FDCWD, 2: RENAME_EXCHANGE
        if rename is None or rename(-100, bytes(part), -100, bytes(folder), 2):
            old = folder.rename(folder.with_name(f"{folder.name}.old"))
            old.rename(part.rename(folder).with_name(part.name))
    finally:
        shutil.rmtree(part, ignore_errors=True)
