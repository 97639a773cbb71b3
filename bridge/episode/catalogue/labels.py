"""Labels given after the fact: a sidecar under ``notes/``; no episode is rewritten."""

import json
from dataclasses import asdict
from pathlib import Path

from bridge.episode.catalogue.entry import LABEL_SUFFIX
from bridge.episode.metadata import Outcome, build
from bridge.episode.reader import Episode
from bridge.episode.run import EPISODE_ID, RunFolder, check_episode_id
from bridge.errors import PathNotFoundError
from bridge.task.record import check_record, parse_record
from bridge.whole_file import write_whole


def sidecar_path(run: RunFolder, episode_id: str) -> Path:
    """Where the label of an episode is kept."""
    return run.notes_dir / f"{check_episode_id(episode_id)}{LABEL_SUFFIX}"


def outcome_of(run: RunFolder, episode: Episode) -> Outcome | None:
    """Return the label given after the fact if there is one, else what the episode says."""
    if not EPISODE_ID.fullmatch(episode.path.stem):
        return episode.outcome  # a file of another program; it cannot have been labelled here
    path = sidecar_path(run, episode.path.stem)
    if not path.is_file():
        return episode.outcome
    return build(Outcome, parse_record(path.read_bytes(), name="outcome"))


def write_label(run: RunFolder, episode_id: str, outcome: Outcome) -> Path:
    """Write the sidecar of a finished episode.

    Raises:
        PathNotFoundError: When there is no such episode; lists those that are there.
        InvalidRecordError: When the outcome does not fit its schema.
    """
    path = sidecar_path(run, episode_id)
    episode = run.episodes_dir / f"{episode_id}.mcap"
    if not episode.is_file():
        names = ", ".join(path.stem for path in run.episodes()[:10]) or "none"
        raise PathNotFoundError(path=episode, what="episode", hint=f"Episodes here: {names}.")
    record = json.loads(json.dumps(asdict(outcome)))
    check_record(record, name="outcome")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, (json.dumps(record, indent=1) + "\n").encode())
    return path
