"""One line of the catalogue, and the traces by which a change of its files is noticed.

Opens no file, so that listing what is known costs no more than a look at the folder.
"""

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from bridge.episode.run import RunFolder, grouped_parts, part_paths

LABEL_SUFFIX = ".outcome.json"
"""Of the sidecar under ``notes/`` that holds a label given after the fact."""
UNSETTLED_NS = 2_000_000_000
"""A file changed this recently may change again within one tick of the disk's clock [ns]."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of ``robot-gst ls``. ``error`` is set when the files could not be read."""

    file: str
    """Name of the first part."""
    id: str
    kind: str = ""
    task: str = ""
    condition: str = ""
    policy: str = ""
    start_id: str | None = None
    trial: int | None = None
    operator: str = ""
    robot: str = ""
    cell: str = ""
    stand_in: bool = False
    tags: tuple[str, ...] = ()
    outcome: str = "unknown"
    """success, failure or unknown; a label given after the fact wins."""
    start_ns: int = 0
    """First log time [ns]."""
    duration_s: float = 0.0
    messages: int = 0
    size_bytes: int = 0
    """Of all parts."""
    parts: int = 1
    lost: int | None = None
    """Messages the recorder declared lost; None when nobody counted."""
    recovered: bool = False
    """Its writer was killed, so its tail is missing."""
    error: str = ""


@dataclass(frozen=True)
class Trace:
    """What the disk says of an episode's files without opening them."""

    path: Path
    stamp: str
    """Size, times and inode of each part and of the label; "" when it cannot be relied on."""


def scan(run: RunFolder) -> dict[str, Trace]:
    """Look at every file once; by printable name of the first part, in name order."""
    now_ns = time.time_ns()
    names = _names(run.episodes_dir, ".mcap")
    labels = set(_names(run.notes_dir, LABEL_SUFFIX))
    return {
        printable(name): trace(
            run,
            run.episodes_dir / name,
            labels,
            now_ns,
            [run.episodes_dir / part for part in parts],
        )
        for name, parts in grouped_parts(names).items()
    }


def _names(folder: Path, suffix: str) -> list[str]:
    try:
        return [name for name in os.listdir(folder) if name.endswith(suffix)]  # noqa: PTH208
    except OSError:  # not there, or not ours to read
        return []


def trace(
    run: RunFolder,
    path: Path,
    labels: set[str] | None = None,
    now_ns: int | None = None,
    parts: list[Path] | None = None,
) -> Trace:
    """Look at the files of one episode.

    Args:
        run: The run folder.
        path: First part.
        labels: Names of the sidecars that exist; None looks.
        now_ns: Wall time; None asks the clock [ns].
        parts: All its files; None looks.
    """
    now_ns = time.time_ns() if now_ns is None else now_ns
    files = part_paths(path) if parts is None else [*parts]
    label = f"{path.stem}{LABEL_SUFFIX}"
    if labels is None or label in labels:
        files.append(run.notes_dir / label)
    return Trace(path, stamp_of(files, now_ns))


def stamp_of(files: Iterable[Path | str], now_ns: int) -> str:
    """Return size, times and inode of each file; "" when one changed a moment ago."""
    marks = []
    for file in files:
        try:
            found = os.stat(file)  # noqa: PTH116  # half the time of the method, for many files
        except OSError:
            marks.append("-")
            continue
        if abs(now_ns - found.st_mtime_ns) < UNSETTLED_NS:
            return ""
        marks.append(f"{found.st_size}.{found.st_mtime_ns}.{found.st_ctime_ns}.{found.st_ino}")
    return " ".join(marks)


def printable(text: str) -> str:
    """Spell out what is no valid Unicode, so that it can be stored and shown."""
    return text.encode("utf-8", "backslashreplace").decode()
