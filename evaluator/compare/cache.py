"""What was read from files that have not changed since, kept in Parquet beside the results.

A summary is a frozen dataclass that follows from the bytes of a few files and from nothing else.
It is kept under a key that names those bytes by their content hash, together with a digest of the
code that makes summaries, so that neither a changed file nor changed code is answered from here.
``docs/decisions/0040-what-an-evaluation-remembers.md`` says why.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from evaluator.compare.cache_folder import CacheFolder, Found, Say

Summary = TypeVar("Summary")

FOLDER = "cache"
"""Beside ``results.json``."""
SAVE_PERIOD_S = 20.0
"""An evaluation that is killed loses no more work than this."""
MOST_FILES = 4
"""A kind of summary in more files than this is folded into one."""
MOST_UNUSED = 0.2
"""So is one of which a larger share is about files that are gone or have changed."""


@dataclass
class _Kept:
    """All summaries of one kind."""

    found: Found
    new: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    """Those no file holds yet; also among the rows found."""
    used: set[str] = field(default_factory=set)

    @property
    def is_untidy(self) -> bool:
        rows, files = self.found.rows, self.found.files
        unused = len(rows) - len(self.used)
        return (
            bool(self.found.useless)
            or len(files) + bool(self.new) > MOST_FILES
            or unused > MOST_UNUSED * len(rows)
        )


class SummaryCache:
    """Summaries by kind and key. Use as a context manager, which keeps what was made.

    Nothing that is wrong with the folder ends an evaluation: it only takes longer.
    """

    def __init__(
        self,
        folder: Path | None,
        *,
        fresh: bool = False,
        say: Say = lambda text: None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """Use a folder, which need not exist.

        Args:
            folder: None keeps nothing.
            fresh: Believe nothing that was kept, and keep what is made now.
            say: Called with one sentence about whatever makes the evaluation take longer.
            monotonic: The clock of periodic saving [s].
        """
        self._folder = None if folder is None else CacheFolder(folder, say)
        self._fresh = fresh
        self._monotonic = monotonic
        self._saved_s = monotonic()
        self._kept: dict[type[Any], _Kept] = {}

    def kept_or_made(
        self, kind: type[Summary], key: str, make: Callable[[], tuple[Summary, ...]]
    ) -> tuple[Summary, ...]:
        """Return what is kept under a key, or make and keep it; what ``make`` raises passes."""
        found = self.find(kind, key)
        if found is None:
            found = make()
            self.keep(kind, key, found)
        return found

    def find(self, kind: type[Summary], key: str) -> tuple[Summary, ...] | None:
        """Return what is kept under a key, None where nothing is."""
        kept = self._of(kind)
        found = kept.found.rows.get(key)
        if found is not None:
            kept.used.add(key)
        return found

    def keep(self, kind: type[Summary], key: str, made: tuple[Summary, ...]) -> None:
        """Keep summaries under a key; now and then everything new is written."""
        if self._folder is None or not self._folder.is_of_use:
            return
        kept = self._of(kind)
        kept.found.rows[key] = kept.new[key] = made
        kept.used.add(key)
        if self._monotonic() - self._saved_s > SAVE_PERIOD_S:
            self.save()

    def save(self) -> None:
        """Write what no file holds yet."""
        for kind, kept in self._kept.items():
            if kept.new:
                self._write(kind, kept, kept.new)
        self._saved_s = self._monotonic()

    def close(self) -> None:
        """Write what is new, and drop what this evaluation had no use for."""
        for kind, kept in self._kept.items():
            if kept.is_untidy:
                self._fold(kind, kept)
        self.save()
        if self._folder is not None:
            self._folder.sweep()

    def _fold(self, kind: type[Any], kept: _Kept) -> None:
        before = [*kept.found.files, *kept.found.useless]
        used = {key: kept.found.rows[key] for key in kept.used}
        if self._folder is None or (used and not self._write(kind, kept, used)):
            return
        for path in before:  # only now: what replaces them is on the disk
            self._folder.remove(path)

    def _write(self, kind: type[Any], kept: _Kept, rows: dict[str, tuple[Any, ...]]) -> bool:
        path = None if self._folder is None else self._folder.write(kind, rows)
        if path is None:
            return False
        kept.found.files.append(path)
        kept.new = {}
        return True

    def _of(self, kind: type[Any]) -> _Kept:
        if kind not in self._kept:
            if self._folder is None:
                found = Found()
            elif self._fresh:
                found = Found(useless=self._folder.files_of(kind))
            else:
                found = self._folder.read(kind)
            self._kept[kind] = _Kept(found)
        return self._kept[kind]

    def __enter__(self) -> "SummaryCache":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Keep what was made; what an interrupted evaluation did not use is not dropped."""
        if kind is None:
            self.close()
        else:
            self.save()
