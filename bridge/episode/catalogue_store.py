"""The catalogue's entries, queries and cache: one SQLite file per run, safe to delete.

Several processes may use it at once: changes are short immediate transactions. Whatever is wrong
with the file, the answer comes from the episodes themselves; only the next one takes longer.
"""

import contextlib
import json
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Literal

from bridge.episode.assigned import TRIAL_SUFFIX
from bridge.episode.run_folder import RunFolder, file_names, part_paths
from bridge.errors import UsageError, refuse_outside
from bridge.terminal import RARE

UNLABELLED = "nobody labelled it"
"""Why the outcome of a trial is unknown that has no label."""
LABEL_SUFFIX = ".outcome.json"
"""Of the sidecar under ``notes/`` that holds a label given after the fact."""
SIDECARS = (LABEL_SUFFIX, TRIAL_SUFFIX)
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
    instruction: str = ""
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
    cause: str = ""
    """Why the outcome is unknown, where somebody said so."""
    start_ns: int = 0
    """First log time [ns]."""
    duration_s: float = 0.0
    messages: int = 0
    size_bytes: int = 0
    """Of all parts."""
    parts: int = 1
    lost: int | None = None
    """Messages the recorder logged as dropped; None when nobody counted."""
    recovered: bool = False
    """Its writer was killed, so its tail is missing."""
    presence: str = ""
    """Topics that broke the contract, fell silent, or whose losses nobody can see."""
    error: str = ""


@dataclass(frozen=True)
class Trace:
    """What the disk says of an episode's files without opening them."""

    path: Path
    stamp: str
    """Size, times and inode of each part and of the sidecars; "" when it cannot be relied on."""


def scan(run: RunFolder) -> dict[str, Trace]:
    """Look at every file once; by printable name of the first part, in name order."""
    now_ns = time.time_ns()
    labels = {name for suffix in SIDECARS for name in file_names(run.notes_dir, suffix)}
    return {
        printable(name): trace(
            run,
            run.episodes_dir / name,
            labels,
            now_ns,
            [run.episodes_dir / part for part in parts],
        )
        for name, parts in run.episode_parts().items()
    }


def trace(
    run: RunFolder,
    path: Path,
    labels: set[str] | None = None,
    now_ns: int | None = None,
    parts: list[Path] | None = None,
) -> Trace:
    """Look at the files of one episode.

    Args:
        labels: Names of the sidecars that exist; None looks.
        now_ns: Wall time; None asks the clock [ns].
        parts: All its files; None looks.
    """
    now_ns = time.time_ns() if now_ns is None else now_ns
    files = part_paths(path) if parts is None else [*parts]
    for sidecar in (f"{path.stem}{suffix}" for suffix in SIDECARS):
        if labels is None or sidecar in labels:
            files.append(run.notes_dir / sidecar)
    return Trace(path, stamp_of(files, now_ns))


def stamp_of(files: Iterable[Path | str], now_ns: int) -> str:
    """Return size, times and inode of each file; "" when one changed a moment ago.

    Args:
        files: The parts of one episode; one that is not there counts as such.
        now_ns: The system clock, which the files' change times are compared with [ns since 1970].
    """
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


Order = Literal["name", "start", "duration", "size", "messages", "lost", "task", "outcome"]
_COLUMNS: dict[str, str] = {
    "name": "file",
    "start": "start_ns",
    "duration": "duration_s",
    "size": "size_bytes",
}


_EXACT = ("kind", "task", "condition", "policy", "operator", "cell", "robot", "outcome")
_SEARCHED = (*_EXACT, "id", "instruction", "tags", "cause", "presence", "error")


@dataclass(frozen=True, kw_only=True)
class CatalogueQuery:
    """Filters; an episode must pass all that are given. One given twice takes either value."""

    kind: tuple[str, ...] = ()
    """scan, trial, retry, probe or imported."""
    task: tuple[str, ...] = ()
    """Id of the task file."""
    condition: tuple[str, ...] = ()
    """without_replanning or with_replanning."""
    policy: tuple[str, ...] = ()
    """Name of the planner or policy."""
    operator: Annotated[tuple[str, ...], RARE] = ()
    """Who was there."""
    cell: tuple[str, ...] = ()
    """Name of the cell."""
    robot: Annotated[tuple[str, ...], RARE] = ()
    """Which robot."""
    outcome: tuple[str, ...] = ()
    """success, failure or unknown."""
    tag: tuple[str, ...] = ()
    """A tag; of several, all must be there."""
    text: str | None = None
    """These words, in whatever case, in name, task, instruction, tags, cause ..."""
    since: str | None = None
    """Begun at or after this time, for example 2026-03-01 or 2026-03-01T14:30 (local)."""
    until: str | None = None
    """Begun before this time."""
    lost: bool | None = None
    """Only with dropped messages, or recovered after a crash; --no-lost only those without."""
    error: bool | None = None
    """Only those that cannot be read; --no-error only the others."""
    sort: Order = "name"
    """Order of the list."""
    reverse: Annotated[bool, RARE] = False
    """Largest or latest first."""
    limit: int | None = None
    """At most this many."""

    def __post_init__(self) -> None:
        """Refuse what cannot be asked."""
        refuse_outside(self, {"limit": (0, float("inf"))})
        for name in ("since", "until"):
            _instant_ns(name, getattr(self, name))

    def to_sql(self) -> tuple[str, list[Any]]:
        """Return what follows ``SELECT ... FROM episodes``, and its parameters."""
        terms: list[str] = []
        values: list[Any] = []
        for name in _EXACT:
            wanted = getattr(self, name)
            if wanted:
                terms.append(f"{name} IN ({', '.join('?' * len(wanted))})")
                values += wanted
        for tag in self.tag:
            terms.append("has_tag(tags, ?)")
            values.append(tag)
        for name, sign in (("since", ">="), ("until", "<")):
            instant_ns = _instant_ns(name, getattr(self, name))
            if instant_ns is not None:
                terms.append(f"start_ns {sign} ?")
                values.append(instant_ns)
        if self.text is not None:
            terms.append(f"holds({' || char(10) || '.join(_SEARCHED)}, ?)")
            values.append(self.text)
        if self.lost is not None:
            terms.append(f"(ifnull(lost, 0) > 0 OR recovered) = {int(self.lost)}")
        if self.error is not None:
            terms.append(f"(error != '') = {int(self.error)}")
        where = f"WHERE {' AND '.join(terms)} " if terms else ""
        direction = "DESC" if self.reverse else "ASC"
        column = _COLUMNS.get(self.sort, self.sort)
        text = f"{where}ORDER BY {column} {direction}, file {direction}"
        if self.limit is not None:
            text += " LIMIT ?"
            values.append(self.limit)
        return text, values

    def sort_key(self, entry: Entry) -> tuple[bool, Any, str]:
        """What an entry is ordered by, where the answers of several runs are put together."""
        value = getattr(entry, _COLUMNS.get(self.sort, self.sort))
        return value is not None, value, entry.file


def _instant_ns(name: str, text: str | None) -> int | None:
    if text is None:
        return None
    try:
        return round(datetime.fromisoformat(text).timestamp() * 1e6) * 1000
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(
            f"--{name} {text!r} is no date or time. "
            "Write it like 2026-03-01 or 2026-03-01T14:30, with +01:00 behind it if not local."
        ) from error


FILE_NAME = "catalogue.sqlite"
VERSION = 5
"""Raise it whenever a column, or the way one is read from an episode, changes."""
BUSY_S = 5.0

_NAMES = [item.name for item in fields(Entry)]
_INTEGERS = {"trial", "stand_in", "start_ns", "messages", "size_bytes", "parts", "lost"}
_INTEGERS |= {"recovered"}


_OPTIONAL = {"start_id", "trial", "lost"}


def _column(name: str) -> str:
    kind = "INTEGER" if name in _INTEGERS else "REAL" if name == "duration_s" else "TEXT"
    key = " PRIMARY KEY" if name == "file" else ""
    return f"{name} {kind}{key}{'' if name in _OPTIONAL else ' NOT NULL'}"


def _allowed(name: str) -> tuple[type, ...]:
    kind = int if name in _INTEGERS else float if name == "duration_s" else str
    return (kind, type(None)) if name in _OPTIONAL else (kind,)


_ALLOWED = [_allowed(name) for name in _NAMES]


_CREATE = f"CREATE TABLE episodes ({', '.join(map(_column, _NAMES))}, stamp TEXT NOT NULL)"
_INSERT = f"INSERT OR REPLACE INTO episodes VALUES ({', '.join('?' * (len(_NAMES) + 1))})"
_SELECT = f"SELECT {', '.join(_NAMES)} FROM episodes "


class CatalogueStore:
    """Rows by file name, each with the stamp of the files it was read from."""

    def __init__(self, path: Path | None, *, busy_s: float = BUSY_S) -> None:
        """Open the file, made where needed; None keeps everything in memory.

        Raises:
            sqlite3.Error: When it cannot be opened, or is no database.
        """
        self._db = _connect(path, busy_s)
        try:
            self._prepare()
        except BaseException:
            self._db.close()
            raise

    def _prepare(self) -> None:
        """Make the table; one of another version is made anew."""
        if self._version() == VERSION:
            return
        with self._transaction():
            if self._version() != VERSION:  # another process may have been quicker
                self._db.execute("DROP TABLE IF EXISTS episodes")
                self._db.execute(_CREATE)
                self._db.execute(f"PRAGMA user_version = {VERSION}")

    def _version(self) -> int:
        return int(self._db.execute("PRAGMA user_version").fetchone()[0])

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._db.execute("ROLLBACK")
            raise
        self._db.execute("COMMIT")

    def stamps(self) -> dict[str, str]:
        """The stamp of every row by file name."""
        found = dict(self._db.execute("SELECT file, stamp FROM episodes"))
        if not all(isinstance(text, str) for pair in found.items() for text in pair):
            raise sqlite3.DatabaseError("a name or stamp is no text")
        return found

    def change(self, rows: Iterable[tuple[Entry, str]], gone: Iterable[str] = ()) -> None:
        """Put rows in, in place of those of the same file, and take others out, all or nothing.

        Args:
            rows: Entries with the stamp of their files (see ``stamp_of``).
        """
        values = [_values(entry, stamp) for entry, stamp in rows]
        with self._transaction():
            self._db.executemany("DELETE FROM episodes WHERE file = ?", [(name,) for name in gone])
            self._db.executemany(_INSERT, values)

    def select(self, clause: str, values: Sequence[Any]) -> list[Entry]:
        """Return the rows a clause picks.

        Args:
            clause: SQL after ``FROM episodes``, with ``?`` where a value goes; never text of a
                user.
        """
        try:
            return [_entry(row) for row in self._db.execute(_SELECT + clause, values)]
        except (TypeError, ValueError) as error:  # somebody wrote into the file
            raise sqlite3.DatabaseError(str(error)) from error

    def move_to_memory(self) -> None:
        """Go on without the file: it is read-only, locked, or its disk is full."""
        memory = CatalogueStore(None)
        with contextlib.suppress(sqlite3.Error):  # then it starts empty
            self._db.backup(memory._db)
        self._db.close()
        self._db = memory._db

    def __enter__(self) -> "CatalogueStore":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close."""
        self._db.close()


def is_damaged(error: sqlite3.Error) -> bool:
    """Say whether the file is to blame, rather than who holds it or where it lies."""
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
    return code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_ERROR)


def _connect(path: Path | None, busy_s: float) -> sqlite3.Connection:
    name = ":memory:" if path is None else str(path)
    connection = sqlite3.connect(name, timeout=busy_s, isolation_level=None)
    connection.create_function(
        "has_tag", 2, lambda tags, tag: tag in json.loads(tags), deterministic=True
    )
    connection.create_function("holds", 2, _holds, deterministic=True)
    return connection


def _holds(text: str, words: str) -> bool:
    """Whether all words are there, in any order and case."""
    folded = text.casefold()
    return all(word in folded for word in words.casefold().split())


def _values(entry: Entry, stamp: str) -> list[Any]:
    record = {**vars(entry), "tags": json.dumps(entry.tags)}
    return [*(record[name] for name in _NAMES), stamp]


def _entry(row: tuple[Any, ...]) -> Entry:
    if not all(map(isinstance, row, _ALLOWED)):
        raise ValueError("a column has the wrong type")
    record = dict(zip(_NAMES, row, strict=True))
    record["tags"] = tuple(json.loads(record["tags"]))
    record["stand_in"], record["recovered"] = bool(record["stand_in"]), bool(record["recovered"])
    return Entry(**record)
