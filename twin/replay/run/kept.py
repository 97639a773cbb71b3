"""Replays that were made before, and count again."""

import contextlib
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from twin.replay.work.job import ReplayJob, row_of_existing


def there_already(
    jobs: Sequence[ReplayJob], *, force: bool
) -> tuple[list[dict[str, Any]], list[ReplayJob]]:
    """Rows of the replays that were made before, and the jobs that are still to do.

    Args:
        jobs: What is asked for.
        force: All of it is to do.
    """
    rows, todo, kept = [], [], []
    for job in jobs:
        row = None if force else row_of_existing(job)
        if row is None:
            todo.append(job)
        else:
            rows.append(row)
            kept.append(job.path())
    _count_again(kept)
    return rows, todo


def _count_again(kept: Iterable[Path]) -> None:
    """Make kept files the newest of their trajectory, for the newest is the one that counts.

    What was replayed with other settings meanwhile would count otherwise, although these were
    asked for last.
    """
    newest: dict[Path, dict[str, int]] = {}
    for path in kept:
        stamps = newest.get(path.parent)
        if stamps is None:
            stamps = newest[path.parent] = _stamps(path.parent)
        with contextlib.suppress(OSError):  # a folder that is only read keeps its order
            if path.stat().st_mtime_ns < stamps[_trajectory_of(path.name)]:
                os.utime(path)


def _stamps(folder: Path) -> dict[str, int]:
    """When the newest replay of each trajectory was made."""
    stamps: dict[str, int] = {}
    for entry in os.scandir(folder):
        if entry.name.endswith(".mcap"):
            key = _trajectory_of(entry.name)
            stamps[key] = max(stamps.get(key, 0), entry.stat().st_mtime_ns)
    return stamps


def _trajectory_of(name: str) -> str:
    """Leave out engine and settings: the end of ``ReplayJob.path``."""
    return name.rsplit(".", 3)[0]
