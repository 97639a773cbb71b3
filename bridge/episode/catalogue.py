"""A run's episodes at a glance: listed, filtered and labelled.

The answers come from ``catalogue.sqlite`` in the run folder, a cache that is brought up to date
before each answer: one look at the folder, and only files that changed are opened.
"""

import contextlib
import json
import sqlite3
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from bridge.episode.assigned import assign
from bridge.episode.catalogue_store import (
    FILE_NAME,
    LABEL_SUFFIX,
    UNLABELLED,
    CatalogueQuery,
    CatalogueStore,
    Trace,
    is_damaged,
    printable,
    scan,
    trace,
)
from bridge.episode.catalogue_store import Entry as Entry
from bridge.episode.contract import PRESENCE_RECORD, presence_lines
from bridge.episode.metadata import Outcome, build
from bridge.episode.reader import Episode
from bridge.episode.run_folder import EPISODE_ID, RunFolder, check_episode_id, first_part
from bridge.errors import GstError, MissingDependencyError, PathNotFoundError, UsageError
from bridge.task.find import chosen_task_file, keep_task_file
from bridge.task.record import check_record, parse_record
from bridge.whole_file import write_whole


def write_parquet(entries: Sequence[Entry], path: Path) -> None:
    """Write one row per episode; columns are the fields of ``Entry``, times in ns.

    Args:
        path: The file to write; an older one is replaced.

    Raises:
        MissingDependencyError: Without pa.
    """
    try:
        import pyarrow as pa  # noqa: PLC0415  # only for this export
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(
            package="pyarrow", extra="report", purpose="exporting the catalogue to Parquet"
        ) from error

    types: dict[Any, Any] = {
        str: pa.string(),
        str | None: pa.string(),
        int: pa.int64(),
        int | None: pa.int64(),
        float: pa.float64(),
        bool: pa.bool_(),
        tuple[str, ...]: pa.list_(pa.string()),
    }
    names = [(item.name, types[item.type]) for item in fields(Entry)]
    rows = [{**vars(entry), "tags": list(entry.tags)} for entry in entries]
    table = pa.Table.from_pylist(rows, schema=pa.schema(names))
    sink = pa.BufferOutputStream()
    parquet.write_table(table, sink, compression="zstd")
    write_whole(path, sink.getvalue().to_pybytes())


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
    """
    path = run.path / FILE_NAME
    if not run.episodes_dir.is_dir():  # somebody else's folder: nothing is written into it
        return _answer(run, CatalogueStore(None), query, advance)
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


def sidecar_path(run: RunFolder, episode_id: str) -> Path:
    """Where the label of an episode is kept.

    Args:
        episode_id: Its id, which must be safe as a file name.
    """
    return run.notes_dir / f"{check_episode_id(episode_id)}{LABEL_SUFFIX}"


def outcome_of(run: RunFolder, episode: Episode) -> Outcome | None:
    """Return the label given after the fact if there is one, else what the episode says.

    Args:
        episode: One of its episodes; the label is looked up by the name of its file.
    """
    if not EPISODE_ID.fullmatch(episode.path.stem):
        return episode.outcome  # a file of another program; it cannot have been labelled here
    path = sidecar_path(run, episode.path.stem)
    if not path.is_file():
        return episode.outcome
    return build(Outcome, parse_record(path.read_bytes(), name="outcome"))


def write_label(run: RunFolder, episode_id: str, outcome: Outcome) -> Path:
    """Write the sidecar of a finished episode.

    Args:
        outcome: The label, in place of any that was there.

    Raises:
        PathNotFoundError: When there is no such episode; lists those that are there.
        InvalidRecordError: When the outcome does not fit its schema.
    """
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


_LARGEST = 2**63 - 1


def read_entry(run: RunFolder, path: Path) -> Entry:
    """Open an episode and sum it up; a broken one is listed with its error."""
    parts: tuple[Path, ...] = (path,)
    name: dict[str, Any] = {"file": printable(path.name), "id": printable(path.stem)}
    try:
        episode = Episode.open(path)
        parts = episode.parts
        info, outcome = episode.info, outcome_of(run, episode)
        messages = sum(topic.count for topic in episode.topics().values())
    except GstError as error:
        return Entry(**name, **_extent(parts), error=printable(str(error)))
    records = episode.metadata_records
    return Entry(
        **name,
        **_extent(parts),
        kind=printable(info.kind),
        task=printable(info.task),
        instruction=printable(info.instruction),
        condition=printable(info.condition),
        policy=printable(info.policy),
        start_id=None if info.start_id is None else printable(info.start_id),
        trial=None if info.trial is None else _fit(info.trial),
        operator=printable(info.operator),
        robot=printable(info.robot),
        cell=printable(info.cell),
        stand_in=info.stand_in,
        tags=tuple(printable(str(tag)) for tag in info.tags),
        outcome=printable(outcome.result) if outcome else "unknown",
        cause=printable(_cause(info.kind, outcome)),
        start_ns=_fit(episode.start_ns),
        duration_s=episode.duration_s,
        messages=messages,
        lost=_declared_lost(records.get("drops")),
        recovered="recovered" in records,
        presence=printable("; ".join(presence_lines(records.get(PRESENCE_RECORD, {})))),
    )


def _cause(kind: str, outcome: Outcome | None) -> str:
    """Why an outcome is unknown; a scan has none, and needs none."""
    if outcome is None:
        return UNLABELLED if kind == "trial" else ""
    return outcome.detail or "" if outcome.result == "unknown" else ""


def _extent(parts: tuple[Path, ...]) -> dict[str, Any]:
    sizes = [part.stat().st_size for part in parts if part.is_file()]
    return {"size_bytes": sum(sizes), "parts": len(parts)}


def _declared_lost(drops: dict[str, Any] | None) -> int | None:
    if drops is None:
        return None
    counts: Iterable[Any] = (drops.get(name, 0) for name in ("gaps", "queue_drops", "shed"))
    found = [count for count in counts if isinstance(count, int)]
    return _fit(sum(found)) if len(found) == 3 else None


def _fit(number: int) -> int:
    """Clamp to what a database column holds; other programs write what they like."""
    return max(-_LARGEST, min(_LARGEST, number))


EVERYTHING = CatalogueQuery()
NOTE_BUSY_S = 0.2
"""How long a recorder waits for another process that is writing the catalogue [s]."""


RUNS_DEEP = 3
"""How far below a folder its runs are looked for."""


def find_runs(folder: Path) -> list[RunFolder]:
    """Return a run, or all runs of a folder of runs, by name.

    Raises:
        PathNotFoundError: When there is no such folder.
        UsageError: When there is none in it.
    """
    run = RunFolder.open(folder)
    if run.episodes_dir.is_dir():
        return [run]
    patterns = ("/".join(["*"] * depth + ["episodes"]) for depth in range(1, RUNS_DEEP + 1))
    found = {each.parent for pattern in patterns for each in folder.glob(pattern) if each.is_dir()}
    runs = [RunFolder(path) for path in sorted(found) if not path.name.startswith(".")]
    if not runs:
        run.refuse_empty()
    return runs


def find_in_runs(
    runs: Sequence[RunFolder], query: CatalogueQuery, *, advance: Advance | None = None
) -> list[tuple[RunFolder, Entry]]:
    """Return the episodes of several runs that pass all filters, in one order."""
    found = [
        (run, entry)
        for run in runs
        for entry in find_episodes(run, replace(query, limit=None), advance=advance)
    ]
    if len(runs) > 1:
        key = query.sort_key
        found.sort(key=lambda pair: (*key(pair[1]), str(pair[0].path)), reverse=query.reverse)
    return found[: query.limit]


def list_episodes(run: RunFolder) -> list[Entry]:
    """Return an entry for every recorded episode; a broken one is listed with its error."""
    return find_episodes(run, EVERYTHING)


def label_episode(run: RunFolder, episode_id: str, outcome: Outcome) -> Path:
    """Write a label beside the run; the episode file is not touched.

    Args:
        run: The run that holds the episode; its catalogue is brought up to date.
        outcome: The label, in place of any that was there.
    """
    path = write_label(run, episode_id, outcome)
    note_finished(run, run.episodes_dir / f"{episode_id}.mcap")
    return path


def assign_trial(
    run: RunFolder, episode_id: str, *, task: str, start_id: str | None, policy: str | None
) -> Path:
    """Note that an episode is a trial of a task, beside the run.

    Args:
        start_id: Start it shares with others; None: as it says itself.
        policy: What moved the robot; None: as it says itself.
    """
    path, name = _finished(run, episode_id), task_of_run(run, task)
    info = Episode.open(path).info
    note = assign(run, path, info, task=name, start_id=start_id, policy=policy)
    note_finished(run, path)
    return note


def task_of_run(run: RunFolder, task: str) -> str:
    """Return the name of a task, given by its name or its file, which the run then keeps.

    Raises:
        UsageError: When there is none of that name.
    """
    file = chosen_task_file(task, tasks_dir=run.tasks_dir)
    name = file.task().name
    if task.endswith(".toml"):
        keep_task_file(run.tasks_dir, name, file.data)
    return name


def refuse_without_task(run: RunFolder, episode_id: str) -> None:
    """Refuse to label what nobody would count: an imported episode of no task.

    Raises:
        UsageError: Saying how to make it a trial.
    """
    if Episode.open(_finished(run, episode_id)).info.kind == "imported":
        raise UsageError(
            f"{episode_id} was imported and is no trial yet: say of which task, --task NAME."
        )


def note_finished(run: RunFolder, path: Path) -> None:
    """Enter one episode, so that whoever reads the database finds it; takes milliseconds.

    Never raises: the next listing enters what is missing.
    """
    with contextlib.suppress(Exception):  # a cache is not worth an episode
        first = first_part(path)
        found = trace(run, first)
        with CatalogueStore(run.path / FILE_NAME, busy_s=NOTE_BUSY_S) as store:
            store.change([(read_entry(run, first), found.stamp)])
