"""A run's episodes at a glance: listed, filtered and labelled.

The answers come from ``catalogue.sqlite`` in the run folder, a cache that is brought up to date
before each answer: one look at the folder, and only files that changed are opened.
"""

import contextlib
from pathlib import Path

from bridge.episode.catalogue_entry import Entry as Entry
from bridge.episode.catalogue_entry import trace
from bridge.episode.catalogue_find import find_episodes as find_episodes
from bridge.episode.catalogue_labels import outcome_of as outcome_of
from bridge.episode.catalogue_labels import write_label
from bridge.episode.catalogue_query import CatalogueQuery
from bridge.episode.catalogue_reading import read_entry
from bridge.episode.catalogue_store import FILE_NAME, CatalogueStore
from bridge.episode.metadata import Outcome
from bridge.episode.run import RunFolder, first_part

EVERYTHING = CatalogueQuery()
NOTE_BUSY_S = 0.2
"""How long a recorder waits for another process that is writing the catalogue [s]."""


def list_episodes(run: RunFolder) -> list[Entry]:
    """Return an entry for every recorded episode; a broken one is listed with its error."""
    return find_episodes(run, EVERYTHING)


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
