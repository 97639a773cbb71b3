"""Read a LeRobotDataset v3.0: its list of episodes, and their rows in the order of the files."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bridge.errors import UsageError
from bridge.exchange.lerobot.layout import DatasetInfo, LeRobotFormatError, parquet

BATCH_ROWS = 1024
_RESTORE = "Restore it from the original dataset."


@dataclass(frozen=True, kw_only=True)
class VideoSpan:
    """Where an episode's frames of one camera lie."""

    path: Path
    from_s: float


@dataclass(frozen=True, kw_only=True)
class EpisodeEntry:
    """One row of ``meta/episodes``."""

    index: int
    length: int
    tasks: tuple[str, ...]
    data_path: Path
    videos: dict[str, VideoSpan]
    """By feature key."""


@dataclass(frozen=True, kw_only=True)
class EpisodeRows:
    """The rows of one episode."""

    entry: EpisodeEntry
    first_row: int
    """Of the data file, for messages."""
    table: Any
    """A ``pyarrow.Table``."""

    def column(self, key: str) -> np.ndarray:
        """Return a numeric column as an array, rows first."""
        values = self.table.column(key).combine_chunks()
        if hasattr(values, "flatten") and "list" in str(values.type):
            return np.asarray(values.flatten()).reshape(len(values), -1)
        return np.asarray(values)


def parse_selection(text: str | None) -> list[range] | None:
    """Read "0-9,12": which episodes are wanted; None is all.

    Raises:
        UsageError: When it is no such list.
    """
    if text is None:
        return None
    ranges = []
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if not first.isdecimal() or not (last.isdecimal() or part.strip() == first):
            message = f"--episodes {text!r} is no list of numbers. Write for example 0-9,12."
            raise UsageError(message)
        ranges.append(range(int(first), int(last or first) + 1))
    return ranges


def read_episodes(info: DatasetInfo, wanted: Sequence[range] | None) -> list[EpisodeEntry]:
    """Read the wanted rows of ``meta/episodes``, in order.

    Raises:
        LeRobotFormatError: Naming the file and row that cannot be believed.
        UsageError: When none of the wanted episodes is there.
    """
    _, pq = parquet()
    paths = sorted((info.folder / "meta" / "episodes").glob("*/*.parquet"))
    if not paths:
        raise LeRobotFormatError(
            path=info.folder / "meta" / "episodes", found="no Parquet files", hint=_RESTORE
        )
    entries: dict[int, EpisodeEntry] = {}
    for path in paths:
        with _readable(path):
            file = pq.ParquetFile(path)
            names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
            number = 0
            for batch in file.iter_batches(batch_size=BATCH_ROWS, columns=names):
                for row in batch.to_pylist():
                    number += 1
                    entry = _entry(info, path, number, row)
                    if wanted is None or any(entry.index in part for part in wanted):
                        entries[entry.index] = entry
    if not entries:
        message = f"none of the wanted episodes is in {info.folder}. It has those in {paths[0]}."
        raise UsageError(message)
    return [entries[index] for index in sorted(entries)]


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn whatever Parquet says of broken bytes into one error that names the file."""
    pa, _ = parquet()
    try:
        yield
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
        raise LeRobotFormatError(
            path=path,
            found=f"cannot be read ({type(error).__name__}: {str(error)[:120]})",
            hint=_RESTORE,
        ) from error


def _entry(info: DatasetInfo, path: Path, number: int, row: dict[str, Any]) -> EpisodeEntry:
    try:
        videos = {
            key: VideoSpan(
                path=info.video_file(
                    key,
                    int(row[f"videos/{key}/chunk_index"]),
                    int(row[f"videos/{key}/file_index"]),
                ),
                from_s=float(row[f"videos/{key}/from_timestamp"]),
            )
            for key, feature in info.features.items()
            if feature.dtype == "video"
        }
        return EpisodeEntry(
            index=int(row["episode_index"]),
            length=int(row["length"]),
            tasks=tuple(str(task) for task in row.get("tasks") or ()),
            data_path=info.data_file(int(row["data/chunk_index"]), int(row["data/file_index"])),
            videos=videos,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise LeRobotFormatError(
            path=path,
            found=f"row {number}: {type(error).__name__} {error}",
            hint="The columns are those of LeRobotDataset v3.0; "
            + _RESTORE[0].lower()
            + _RESTORE[1:],
        ) from error


def iterate_rows(entries: Sequence[EpisodeEntry]) -> Iterator[EpisodeRows]:
    """Yield the rows of each wanted episode; every data file is read once, from front to back.

    Raises:
        LeRobotFormatError: Naming the file and row where an episode is not as its entry says.
    """
    by_file: dict[Path, dict[int, EpisodeEntry]] = {}
    for entry in entries:
        by_file.setdefault(entry.data_path, {})[entry.index] = entry
    for path, wanted in by_file.items():
        found = set()
        for index, first_row, table in _episodes_of(path, set(wanted)):
            rows = EpisodeRows(entry=wanted[index], first_row=first_row, table=table)
            if index in found:
                raise LeRobotFormatError(
                    path=path,
                    found=f"row {first_row}: episode {index} begins a second time",
                    hint="Rows of an episode lie together; " + _RESTORE,
                )
            found.add(index)
            _check(path, rows)
            yield rows
        if set(wanted) - found:
            raise LeRobotFormatError(
                path=path,
                found=f"no rows of episode {min(set(wanted) - found)}, listed as here",
                hint=_RESTORE,
            )


def _episodes_of(path: Path, wanted: set[int]) -> Iterator[tuple[int, int, Any]]:
    """Yield each wanted episode's number, first row and table; one episode is held at a time."""
    pa, pq = parquet()
    held: list[Any] = []
    current, first, row = -1, 0, 0
    with _readable(path):
        file = pq.ParquetFile(path)
        for batch in file.iter_batches(batch_size=BATCH_ROWS):
            numbers = np.asarray(batch.column("episode_index"))
            cuts = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
            for begin, end in pairwise(cuts):
                if begin == end:
                    continue
                if int(numbers[begin]) != current:
                    if held:
                        yield current, first, pa.Table.from_batches(held)
                    held, current, first = [], int(numbers[begin]), row + begin + 1
                if current in wanted:
                    held.append(batch.slice(begin, end - begin))
            row += len(numbers)
        if held:
            yield current, first, pa.Table.from_batches(held)


def _check(path: Path, rows: EpisodeRows) -> None:
    entry = rows.entry
    if rows.table.num_rows != entry.length:
        raise LeRobotFormatError(
            path=path,
            found=f"row {rows.first_row}: episode {entry.index} has {rows.table.num_rows} rows, "
            f"meta/episodes says {entry.length}",
            hint=_RESTORE,
        )
    if "frame_index" in rows.table.column_names:
        wrong = np.flatnonzero(rows.column("frame_index") != np.arange(entry.length))
        if len(wrong):
            raise LeRobotFormatError(
                path=path,
                found=f"row {rows.first_row + int(wrong[0])}: frame_index does not count from 0",
                hint=_RESTORE,
            )
