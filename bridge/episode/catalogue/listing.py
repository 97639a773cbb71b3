"""List all of a run, label an episode, enter a finished one."""

import contextlib
from pathlib import Path

from bridge.episode.catalogue.entry import Entry, trace
from bridge.episode.catalogue.find import find_episodes
from bridge.episode.catalogue.labels import write_label
from bridge.episode.catalogue.query import CatalogueQuery
from bridge.episode.catalogue.reading import read_entry
from bridge.episode.catalogue.store import FILE_NAME, CatalogueStore
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
