"""A run's episodes at a glance: listed, filtered and labelled."""

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bridge.episode.assigned import assign
from bridge.episode.catalogue_query import LABEL_SUFFIX, UNLABELLED, CatalogueQuery, printable
from bridge.episode.catalogue_query import Entry as Entry
from bridge.episode.contract import PRESENCE_RECORD, health_lines
from bridge.episode.health import RECORD_NAME
from bridge.episode.metadata import Outcome, build
from bridge.episode.reader import Episode
from bridge.episode.run_folder import EPISODE_ID, RunFolder, check_episode_id
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.task.find import chosen_task_file, keep_task_file
from bridge.task.record import check_record, parse_record
from bridge.whole_file import write_whole

EVERYTHING = CatalogueQuery()


def find_episodes(run: RunFolder, query: CatalogueQuery = EVERYTHING) -> list[Entry]:
    """Return the episodes that pass all filters, by name; a broken one with its error."""
    found = (read_entry(run, path) for path in run.episodes())
    return sorted(filter(query.takes, found), key=lambda entry: entry.file)


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


def label_episode(run: RunFolder, episode_id: str, outcome: Outcome) -> Path:
    """Write a label beside the run; the episode file is not touched."""
    path = sidecar_path(run, episode_id)
    _finished(run, episode_id)
    record = json.loads(json.dumps(asdict(outcome)))
    check_record(record, name="outcome")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, (json.dumps(record, indent=1) + "\n").encode())
    return path


def _finished(run: RunFolder, episode_id: str) -> Path:
    episode = run.episodes_dir / f"{episode_id}.mcap"
    if not episode.is_file():
        names = ", ".join(path.stem for path in run.episodes()[:10]) or "none"
        raise PathNotFoundError(path=episode, what="episode", hint=f"Episodes here: {names}.")
    return episode


def read_entry(run: RunFolder, path: Path) -> Entry:
    """Open an episode and sum it up; a broken one is listed with its error."""
    size = path.stat().st_size if path.is_file() else 0
    name: dict[str, Any] = {"file": printable(path.name), "id": printable(path.stem)}
    try:
        episode = Episode.open(path)
        info, outcome = episode.info, outcome_of(run, episode)
        messages = sum(topic.count for topic in episode.topics().values())
    except GstError as error:
        return Entry(**name, size_bytes=size, error=printable(str(error)))
    records = episode.metadata_records
    presence = records.get(PRESENCE_RECORD, {})
    about = {key: value for key, value in asdict(info).items() if key in Entry.__annotations__}
    return Entry(
        **{key: _printable(value) for key, value in about.items() if key not in name},
        **name,
        size_bytes=size,
        outcome=printable(outcome.result) if outcome else "unknown",
        cause=printable(_cause(info.kind, outcome)),
        start_ns=episode.start_ns,
        duration_s=episode.duration_s,
        messages=messages,
        lost=_declared_lost(records.get("drops")),
        recovered="recovered" in records,
        presence=printable("; ".join(health_lines({**presence, **records.get(RECORD_NAME, {})}))),
    )


def _printable(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(printable(str(item)) for item in value)
    return printable(value) if isinstance(value, str) else value


def _cause(kind: str, outcome: Outcome | None) -> str:
    """Why an outcome is unknown; a scan has none, and needs none."""
    if outcome is None:
        return UNLABELLED if kind == "trial" else ""
    return outcome.detail or "" if outcome.result == "unknown" else ""


def _declared_lost(drops: dict[str, Any] | None) -> int | None:
    if drops is None:
        return None
    counts: Iterable[Any] = (drops.get(name, 0) for name in ("gaps", "queue_drops", "shed"))
    found = [count for count in counts if isinstance(count, int)]
    return sum(found) if len(found) == 3 else None


def assign_trial(
    run: RunFolder, episode_id: str, *, task: str, start_id: str | None, policy: str | None
) -> Path:
    """Note that an episode is a trial of a task, beside the run."""
    path, name = _finished(run, episode_id), task_of_run(run, task)
    return assign(run, path, Episode.open(path).info, task=name, start_id=start_id, policy=policy)


def task_of_run(run: RunFolder, task: str) -> str:
    """Return the name of a task, given by its name or its file, which the run then keeps."""
    file = chosen_task_file(task, tasks_dir=run.tasks_dir)
    name = file.task().name
    if task.endswith(".toml"):
        keep_task_file(run.tasks_dir, name, file.data)
    return name


def refuse_without_task(run: RunFolder, episode_id: str) -> None:
    """Refuse to label what nobody would count: an imported episode of no task."""
    if Episode.open(_finished(run, episode_id)).info.kind == "imported":
        raise UsageError(
            f"{episode_id} was imported and is no trial yet: say of which task, --task NAME."
        )
