"""Write a file whole or not at all: the final name appears only when every byte is on disk."""

import os
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
