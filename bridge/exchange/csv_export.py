"""Episodes as tidy CSV files, one per family of topics, and one line per episode."""

import csv
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

from bridge.episode.catalogue import outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.errors import UsageError
from bridge.exchange.naming import message_named
from bridge.exchange.output import new_folder, write_note
from bridge.exchange.tables import COMMON, TABLES, TableKind, field_text, seconds_text
from bridge.terminal import Advance

EPISODE_COLUMNS = {
    "file": "the episode file, relative to the run",
    "id": "its id",
    "kind": "scan, trial, probe or imported",
    "task": "what was to be achieved",
    "instruction": "in words",
    "condition": "without_replanning or with_replanning",
    "policy": "who planned",
    "trial": "number of the trial",
    "start_id": "trials with the same start share it",
    "operator": "who watched",
    "robot": "which robot",
    "cell": "which cell",
    "stand_in": "true for a simulated laboratory",
    "result": "success, failure or unknown; a label given afterwards counts",
    "k": "successes",
    "n": "out of so many",
    "start_ns": "first log time [ns]",
    "end_ns": "last log time [ns]",
    "messages": "how many there are",
}
_INFO = tuple(EPISODE_COLUMNS)[1:13]


class _Sheet:
    """One CSV file being written; it is made when its first row comes."""

    def __init__(self, path: Path, columns: Sequence[str], stack: ExitStack) -> None:
        self.rows = 0
        self._path = path
        self._columns = columns
        self._stack = stack
        self._stream: TextIO | None = None

    def write(self, cells: Sequence[str]) -> None:
        if self._stream is None:
            self._stream = self._stack.enter_context(
                self._path.open("w", newline="", encoding="utf-8")
            )
            self._writer = csv.writer(self._stream, lineterminator="\r\n")
            self._writer.writerow(self._columns)
        self._writer.writerow(cells)
        self.rows += 1


def episode_files(source: Path, *, derived: bool) -> tuple[list[Path], Path]:
    """Return the episode files of a run, or the one given, and the folder they are named from.

    Raises:
        UsageError: When there is nothing to export.
    """
    if not source.is_dir():
        return [source], source.parent
    run = RunFolder.open(source)
    files = run.episodes() + (run.derived() if derived else [])
    if not files:
        message = f"no episodes in {source}. Record some: robot-gst record {source}."
        raise UsageError(message)
    return files, source


def export_csv(
    source: Path, out: Path, *, derived: bool, force: bool, advance: Advance
) -> dict[str, int]:
    """Write ``episodes.csv`` and one CSV file per family of topics that has messages.

    Args:
        source: An episode file, or a run folder.
        out: The folder to make.
        derived: Also the replays and localisations of a run.
        force: Replace an earlier export.
        advance: Told how many episodes are done.

    Returns:
        Rows by file name.

    Raises:
        EpisodeError: Naming the episode, topic and message that cannot be read.
        UsageError: When there is nothing to export, or ``out`` may not be replaced.
    """
    files, base = episode_files(source, derived=derived)
    run = RunFolder(base) if source.is_dir() else None
    with new_folder(out, force=force) as folder:
        with ExitStack() as stack:
            sheets = {
                kind.name: _Sheet(folder / f"{kind.name}.csv", [*COMMON, *kind.columns], stack)
                for kind in TABLES
            }
            sheets["episodes"] = _Sheet(folder / "episodes.csv", list(EPISODE_COLUMNS), stack)
            for done, path in enumerate(files, start=1):
                name = path.relative_to(base).as_posix()
                episode = Episode.open(path)
                sheets["episodes"].write(_episode_cells(name, episode, run))
                _write_messages(name, episode, sheets)
                advance(done, name)
        rows = {f"{name}.csv": sheet.rows for name, sheet in sheets.items() if sheet.rows}
        columns = {
            f"{kind.name}.csv": {**COMMON, **kind.columns}
            for kind in TABLES
            if sheets[kind.name].rows
        }
        columns["episodes.csv"] = dict(EPISODE_COLUMNS)
        write_note(
            folder,
            made_by="export csv",
            sources=files,
            choices={"columns": columns, "stand_in_truth": "left out"},
        )
    return rows


def _write_messages(name: str, episode: Episode, sheets: dict[str, _Sheet]) -> None:
    taken = {
        topic: kind
        for topic, summary in episode.topics().items()
        for kind in TABLES
        if kind.takes(topic, summary.type_name)
    }
    for kind, cells in _rows(name, episode, taken):
        sheets[kind.name].write(cells)


def _rows(
    name: str, episode: Episode, taken: dict[str, TableKind]
) -> Iterator[tuple[TableKind, list[str]]]:
    counts = dict.fromkeys(taken, 0)
    for message in episode.messages(taken):
        kind = taken[message.topic]
        counts[message.topic] += 1
        if message.type_name != kind.type_name:  # a topic may carry two types
            continue
        with message_named(episode, message.topic, counts[message.topic]):
            rows = list(kind.rows(message))
        for stamp_ns, values in rows:
            log_ns = str(message.log_time_ns)
            times = [str(stamp_ns), seconds_text(stamp_ns), log_ns]
            yield kind, [name, message.topic, *times, *map(field_text, values)]


def _episode_cells(name: str, episode: Episode, run: RunFolder | None) -> list[str]:
    info = episode.info
    outcome = episode.outcome if run is None else outcome_of(run, episode)
    counted = [None] * 3 if outcome is None else [outcome.result, outcome.k, outcome.n]
    messages = sum(summary.count for summary in episode.topics().values())
    values = [
        *(getattr(info, field) for field in _INFO),
        *counted,
        episode.start_ns,
        episode.end_ns,
        messages,
    ]
    return [name, *map(field_text, values)]
