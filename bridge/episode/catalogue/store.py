"""The catalogue's cache: one SQLite file per run, made from the episodes and safe to delete.

Several processes may use it at once: changes are short immediate transactions. Whatever is wrong
with the file, the answer comes from the episodes themselves; only the next one takes longer.
"""

import contextlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any

from bridge.episode.catalogue.entry import Entry

FILE_NAME = "catalogue.sqlite"
VERSION = 1
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
        """Put rows in, in place of those of the same file, and take others out, all or nothing."""
        values = [_values(entry, stamp) for entry, stamp in rows]
        with self._transaction():
            self._db.executemany("DELETE FROM episodes WHERE file = ?", [(name,) for name in gone])
            self._db.executemany(_INSERT, values)

    def select(self, clause: str, values: Sequence[Any]) -> list[Entry]:
        """Return the rows a clause picks."""
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
    return connection


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
