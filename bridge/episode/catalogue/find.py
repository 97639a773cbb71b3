"""Answers from the catalogue after bringing it up to date.

The modules that open episodes are imported only when there is something to open.
"""

import contextlib
import sqlite3
from collections.abc import Callable, Iterable

from bridge.episode.catalogue.entry import Entry, Trace, scan
from bridge.episode.catalogue.query import CatalogueQuery
from bridge.episode.catalogue.store import FILE_NAME, CatalogueStore, is_damaged
from bridge.episode.run import RunFolder

Advance = Callable[[int, int], None]
"""Called as ``advance(done, total)`` while files are read."""
BATCH = 256
"""Episodes read between two writes; an interrupted first listing keeps what it has."""


def find_episodes(
    run: RunFolder, query: CatalogueQuery, *, advance: Advance | None = None
) -> list[Entry]:
    """Return the episodes that pass all filters.

    Args:
        run: The run folder; if it cannot be written, the answer is the same but takes longer.
        query: What to look for.
        advance: Called while files are read that the catalogue does not know yet.
    """
    path = run.path / FILE_NAME
    try:
        return _answer(run, CatalogueStore(path), query, advance)
    except sqlite3.Error as error:
        damaged = is_damaged(error)
    if damaged:
        with contextlib.suppress(OSError, sqlite3.Error):
            path.unlink()
            return _answer(run, CatalogueStore(path), query, advance)
    return _answer(run, CatalogueStore(None), query, advance)


def _answer(
    run: RunFolder, opened: CatalogueStore, query: CatalogueQuery, advance: Advance | None
) -> list[Entry]:
    with opened as store:
        _refresh(run, store, scan(run), advance)
        return store.select(*query.to_sql())


def _refresh(
    run: RunFolder, store: CatalogueStore, traces: dict[str, Trace], advance: Advance | None
) -> None:
    known = store.stamps()
    gone = known.keys() - traces.keys()
    stale = [
        found for file, found in traces.items() if not found.stamp or known.get(file) != found.stamp
    ]
    if gone:
        _change(store, [], gone)
    if not stale:
        return
    from bridge.episode.catalogue.reading import read_entry  # noqa: PLC0415  # half of the time

    for start in range(0, len(stale), BATCH):
        rows = []
        for found in stale[start : start + BATCH]:
            rows.append((read_entry(run, found.path), found.stamp))
            if advance is not None:
                advance(start + len(rows), len(stale))
        _change(store, rows)


def _change(store: CatalogueStore, rows: list[tuple[Entry, str]], gone: Iterable[str] = ()) -> None:
    try:
        store.change(rows, gone)
    except sqlite3.OperationalError as error:
        if is_damaged(error):
            raise
        store.move_to_memory()
        store.change(rows, gone)
