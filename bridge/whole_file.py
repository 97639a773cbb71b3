"""Write a file whole or not at all: the final name appears only when every byte is on disk."""

import os
from pathlib import Path


def write_whole(path: Path, data: bytes) -> None:
    """Write ``<path>.part``, sync it to disk, and give it its final name."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(path)
