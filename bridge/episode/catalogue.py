"""A run's episodes at a glance: listed, filtered and labelled.

The answers come from ``catalogue.sqlite`` in the run folder, a cache that is brought up to date
before each answer: one look at the folder, and only files that changed are opened.
"""

import contextlib
import itertools
import sqlite3
from collections.abc import Callable, Iterable
from pathlib import Path

from bridge.episode.catalogue_entry import Entry as Entry
from bridge.episode.catalogue_entry import Trace, read_entry, scan, trace
from bridge.episode.catalogue_labels import outcome_of as outcome_of
from bridge.episode.catalogue_labels import write_label
from bridge.episode.catalogue_query import CatalogueQuery
from bridge.episode.catalogue_store import FILE_NAME, CatalogueStore, is_damaged
from bridge.episode.metadata import Outcome
from bridge.episode.run import RunFolder, first_part

Advance = Callable[[int, int], None]
"""Called as ``advance(done, total)`` while files are read."""
EVERYTHING = CatalogueQuery()
BATCH = 256
"""Episodes read between two writes; an interrupted first listing keeps what it has."""
NOTE_BUSY_S = 0.2
"""How long a recorder waits for another process that is writing the catalogue [s]."""


def list_episodes(run: RunFolder) -> list[Entry]:
    """Return an entry for every recorded episode; a broken one is listed with its error."""
    return find_episodes(run, EVERYTHING)


def find_episodes(
    run: RunFolder, query: CatalogueQuery, *, advance: Advance | None = None
) -> list[Entry]:
    """Return the episodes that pass all filters.

    Args:
        run: The run folder; if it cannot be written, the answer is the same but takes longer.
        query: What to look for.
        advance: Called while files are read that the catalogue does not know yet.
    """
    path: Path | None = run.path / FILE_NAME
    while True:
        try:
            with CatalogueStore(path) as store:
                _refresh(run, store, scan(run), advance)
                return store.select(*query.to_sql())
        except sqlite3.Error as error:
            if path is None:
                raise
            path = path if is_damaged(error) and _removed(path) else None


def _removed(path: Path) -> bool:
    """Take a damaged catalogue away; False when there is none or it stays."""
    try:
        path.unlink()
    except OSError:
        return False
    return True


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
    for start in range(0, len(stale), BATCH):
        rows = []
        for found in itertools.islice(stale, start, start + BATCH):
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


def label_episode(run: RunFolder, episode_id: str, outcome: Outcome) -> Path:
    """Write a label beside the run; the episode file is not touched."""
    path = write_label(run, episode_id, outcome)
    note_finished(run, run.episodes_dir / f"{episode_id}.mcap")
    return path


def note_finished(run: RunFolder, path: Path) -> None:
    """Enter one episode, so that whoever reads the database finds it; takes milliseconds.

    Never raises: the next listing enters what is missing.

    Args:
        run: The run folder.
        path: Any part of a finished episode.
    """
    with contextlib.suppress(Exception):  # a cache is not worth an episode
        first = first_part(path)
        found = trace(run, first)
        with CatalogueStore(run.path / FILE_NAME, busy_s=NOTE_BUSY_S) as store:
            store.change([(read_entry(run, first), found.stamp)])
