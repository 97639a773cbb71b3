"""Arrays in a file: NumPy's npz, the same bytes for the same arrays, and no surprise on reading."""

import io
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bridge.whole_file import write_whole
from twin.errors import UnreadableFileError

_UNREADABLE = (OSError, EOFError, ValueError, TypeError, MemoryError)


class UnreadableArraysError(UnreadableFileError):
    """An npz file is damaged, too large, or not what was expected."""


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays, whole or not at all."""
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    write_whole(path, stream.getvalue())


def read_npz(path: Path, names: Sequence[str], max_bytes: int) -> dict[str, np.ndarray]:
    """Read named arrays; sizes are checked before anything is unpacked, pickles are refused."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            missing = [name for name in names if f"{name}.npy" not in archive]
            if missing:
                raise UnreadableArraysError(path=path, found=f"without {', '.join(missing)}")
            total = sum(archive.zip.getinfo(f"{name}.npy").file_size for name in names)
            if total > max_bytes:
                found = f"holds {total} bytes, more than the {max_bytes} that are allowed"
                raise UnreadableArraysError(path=path, found=found)
            return {name: archive[name] for name in names}
    except (*_UNREADABLE, zipfile.BadZipFile, zlib.error) as error:
        raise UnreadableArraysError(path=path, found=f"not a file of arrays ({error})") from error
