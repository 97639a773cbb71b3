"""List a run's episodes, and labels given after the fact (sidecars; no episode is rewritten)."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from bridge.episode.metadata import Outcome, build
from bridge.episode.reader import Episode
from bridge.episode.run import EPISODE_ID, RunFolder, check_episode_id
from bridge.errors import GstError, PathNotFoundError
from bridge.task.record import check_record, parse_record
from bridge.whole_file import write_whole


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of ``robot-gst ls``. ``error`` is set when the file could not be read."""

    file: str
    id: str
    kind: str = ""
    task: str = ""
    condition: str = ""
    policy: str = ""
    start_id: str | None = None
    outcome: str = "unknown"
    duration_s: float = 0.0
    size_bytes: int = 0
    stand_in: bool = False
    error: str = ""


def list_episodes(run: RunFolder) -> list[Entry]:
    """Return an entry for every recorded episode; a broken one is listed with its error."""
    return [_entry(run, path) for path in run.episodes()]


def _entry(run: RunFolder, path: Path) -> Entry:
    size = path.stat().st_size if path.is_file() else 0
    try:
        episode = Episode.open(path)
        info, outcome = episode.info, outcome_of(run, episode)
    except GstError as error:
        return Entry(file=path.name, id=path.stem, size_bytes=size, error=str(error))
    return Entry(
        file=path.name,
        id=path.stem,
        kind=info.kind,
        task=info.task,
        condition=info.condition,
        policy=info.policy,
        start_id=info.start_id,
        outcome=outcome.result if outcome else "unknown",
        duration_s=episode.duration_s,
        size_bytes=size,
        stand_in=info.stand_in,
    )


def _sidecar(run: RunFolder, episode_id: str) -> Path:
    return run.notes_dir / f"{check_episode_id(episode_id)}.outcome.json"


def outcome_of(run: RunFolder, episode: Episode) -> Outcome | None:
    """Return the label given after the fact if there is one, else what the episode says."""
    if not EPISODE_ID.fullmatch(episode.path.stem):
        return episode.outcome  # a file of another program; it cannot have been labelled here
    path = _sidecar(run, episode.path.stem)
    if not path.is_file():
        return episode.outcome
    return build(Outcome, parse_record(path.read_bytes(), name="outcome"))


def label_episode(run: RunFolder, episode_id: str, outcome: Outcome) -> Path:
    """Write a label beside the run; the episode file is not touched."""
    if not (run.episodes_dir / f"{check_episode_id(episode_id)}.mcap").is_file():
        names = ", ".join(path.stem for path in run.episodes()[:10]) or "none"
        raise PathNotFoundError(
            path=run.episodes_dir / f"{episode_id}.mcap",
            what="episode",
            hint=f"Episodes here: {names}.",
        )
    record = json.loads(json.dumps(asdict(outcome)))
    check_record(record, name="outcome")
    path = _sidecar(run, episode_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, (json.dumps(record, indent=1) + "\n").encode())
    return path
