"""One line of the catalogue, and the traces by which a change of its files is noticed."""

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.episode.catalogue_labels import SUFFIX, outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder, first_parts, part_paths
from bridge.errors import GstError

UNSETTLED_NS = 2_000_000_000
"""A file changed this recently may change again within one tick of the disk's clock [ns]."""
_LARGEST = 2**63 - 1


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
    labels = set(_names(run.notes_dir, SUFFIX))
    heads = first_parts(names)
    alone = len(heads) == len(names)
    return {
        printable(name): trace(run, run.episodes_dir / name, labels, now_ns, alone=alone)
        for name in heads
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
    *,
    alone: bool = False,
) -> Trace:
    """Look at the files of one episode.

    Args:
        run: The run folder.
        path: First part.
        labels: Names of the sidecars that exist; None looks.
        now_ns: Wall time; None asks the clock [ns].
        alone: No episode of this run has a second part.
    """
    now_ns = time.time_ns() if now_ns is None else now_ns
    files = [path] if alone else part_paths(path)
    label = f"{path.stem}{SUFFIX}"
    if labels is None or label in labels:
        files.append(run.notes_dir / label)
    marks = []
    for file in files:
        try:
            found = file.stat()
        except OSError:
            marks.append("-")
            continue
        if abs(now_ns - found.st_mtime_ns) < UNSETTLED_NS:
            return Trace(path, "")
        marks.append(f"{found.st_size}.{found.st_mtime_ns}.{found.st_ctime_ns}.{found.st_ino}")
    return Trace(path, " ".join(marks))


def read_entry(run: RunFolder, path: Path) -> Entry:
    """Open an episode and sum it up; a broken one is listed with its error."""
    parts = part_paths(path)
    file = printable(path.name)
    size = sum(part.stat().st_size for part in parts if part.is_file())
    name = {"file": file, "id": printable(path.stem), "size_bytes": size, "parts": len(parts)}
    try:
        episode = Episode.open(path)
        info, outcome = episode.info, outcome_of(run, episode)
        messages = sum(topic.count for topic in episode.topics().values())
    except GstError as error:
        return Entry(**name, error=printable(str(error)))  # type: ignore[arg-type]
    records = episode.metadata_records
    return Entry(
        **name,  # type: ignore[arg-type]
        kind=printable(info.kind),
        task=printable(info.task),
        condition=printable(info.condition),
        policy=printable(info.policy),
        start_id=None if info.start_id is None else printable(info.start_id),
        trial=None if info.trial is None else _fit(info.trial),
        operator=printable(info.operator),
        robot=printable(info.robot),
        cell=printable(info.cell),
        stand_in=info.stand_in,
        tags=tuple(printable(str(tag)) for tag in info.tags),
        outcome=printable(outcome.result) if outcome else "unknown",
        start_ns=_fit(episode.start_ns),
        duration_s=episode.duration_s,
        messages=messages,
        lost=_declared_lost(records.get("drops")),
        recovered="recovered" in records,
    )


def _declared_lost(drops: dict[str, Any] | None) -> int | None:
    if drops is None:
        return None
    counts: Iterable[Any] = (drops.get(name, 0) for name in ("gaps", "queue_drops", "shed"))
    found = [count for count in counts if isinstance(count, int)]
    return _fit(sum(found)) if len(found) == 3 else None


def printable(text: str) -> str:
    """Spell out what is no valid Unicode, so that it can be stored and shown."""
    return text.encode("utf-8", "backslashreplace").decode()


def _fit(number: int) -> int:
    """Clamp to what a database column holds; other programs write what they like."""
    return max(-_LARGEST, min(_LARGEST, number))
