"""Episodes of a LeRobotDataset v3.0 or v2 as episodes of ours, one file each.

Times are nominal: row k is k / fps after 0, because the format keeps no clock. Numbers are kept as
they are, whatever their unit. Video frames become JPEG, which is one more lossy step and is said
so in the metadata ``source``; images inside the tables keep their bytes.
"""

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bridge.clock import ns_from_s
from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, JointSample
from bridge.episode.metadata import EpisodeInfo, Outcome, imported_info
from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import COLOR_IMAGE, JOINT_STATES, camera_topic, cell_topic
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.exchange.lerobot import layout
from bridge.exchange.lerobot.layout import DatasetInfo, LeRobotFormatError, parquet
from bridge.exchange.lerobot.video import read_frames
from bridge.exchange.output import is_of_stand_in
from bridge.media.color import JPEG_MAGIC, JPEG_QUALITY, encode_jpeg
from bridge.terminal import Advance

BATCH_ROWS = 1024


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

    def broken(self, found: str, *, row: int = 0, hint: str = layout.RESTORE) -> LeRobotFormatError:
        """Build the error that names a row of the episode, counted from 0."""
        found = f"row {self.first_row + row}: {found}"
        return LeRobotFormatError(path=self.entry.data_path, found=found, hint=hint)


def parse_selection(text: str | None) -> list[range] | None:
    """Read "0-9,12": which episodes are wanted; None is all."""
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

    Args:
        wanted: Ranges of episode indices; None for all.
    """
    entries: dict[int, EpisodeEntry] = {}
    per_chunk = info.episodes_per_chunk
    rows = _rows_of(info) if per_chunk is None else _lines_of(info, per_chunk)
    for path, number, row in rows:
        entry = _entry(info, path, number, row)
        if wanted is None or any(entry.index in part for part in wanted):
            entries[entry.index] = entry
    if not entries:
        raise UsageError(f"none of the wanted episodes is listed in {info.folder / 'meta'}.")
    return [entries[index] for index in sorted(entries)]


def _rows_of(info: DatasetInfo) -> Iterator[tuple[Path, int, dict[str, Any]]]:
    """Yield the rows of ``meta/episodes``, each with its file and its number."""
    _, pq = parquet()
    paths = sorted((info.folder / "meta" / "episodes").glob("*/*.parquet"))
    if not paths:
        raise LeRobotFormatError(path=info.folder / "meta" / "episodes", found="no Parquet files")
    for path in paths:
        with _readable(path):
            file = pq.ParquetFile(path)
            names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
            batches = file.iter_batches(batch_size=BATCH_ROWS, columns=names)
            rows = (row for batch in batches for row in batch.to_pylist())
            for number, row in enumerate(rows, start=1):
                yield path, number, row


def _lines_of(info: DatasetInfo, per_chunk: int) -> Iterator[tuple[Path, int, dict[str, Any]]]:
    """Yield the lines of version 2's ``meta/episodes.jsonl`` as version 3 has them."""
    path = info.folder / "meta" / "episodes.jsonl"
    with _readable(path), path.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, start=1):
            row = json.loads(line)
            index = int(row["episode_index"])
            place = {"chunk_index": index // per_chunk, "file_index": index}
            for key, feature in info.features.items():
                if feature.dtype == "video":
                    row |= {f"videos/{key}/{name}": at for name, at in place.items()}
                    row[f"videos/{key}/from_timestamp"] = 0.0
            yield path, number, row | {f"data/{name}": at for name, at in place.items()}


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
        ) from error


def _entry(info: DatasetInfo, path: Path, number: int, row: dict[str, Any]) -> EpisodeEntry:
    try:
        videos = {
            key: VideoSpan(
                path=info.file(
                    info.video_path,
                    video_key=key,
                    chunk_index=int(row[f"videos/{key}/chunk_index"]),
                    file_index=int(row[f"videos/{key}/file_index"]),
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
            data_path=info.file(
                info.data_path,
                chunk_index=int(row["data/chunk_index"]),
                file_index=int(row["data/file_index"]),
            ),
            videos=videos,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise LeRobotFormatError(
            path=path,
            found=f"row {number}: {type(error).__name__} {error}",
            hint=f"The columns are those of LeRobotDataset v3.0. {layout.RESTORE}",
        ) from error


def iterate_rows(entries: Sequence[EpisodeEntry]) -> Iterator[EpisodeRows]:
    """Yield the rows of each wanted episode; every data file is read once, from front to back."""
    by_file: dict[Path, dict[int, EpisodeEntry]] = {}
    for entry in entries:
        by_file.setdefault(entry.data_path, {})[entry.index] = entry
    for path, wanted in by_file.items():
        found = set()
        for index, first_row, table in _episodes_of(path, set(wanted)):
            rows = EpisodeRows(entry=wanted[index], first_row=first_row, table=table)
            if index in found:
                raise rows.broken(f"episode {index} begins a second time; its rows lie together")
            found.add(index)
            _check(rows)
            yield rows
        if set(wanted) - found:
            raise LeRobotFormatError(
                path=path,
                found=f"no rows of episode {min(set(wanted) - found)}, listed as here",
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


def _check(rows: EpisodeRows) -> None:
    entry, count = rows.entry, rows.table.num_rows
    if count != entry.length:
        said = f"meta/episodes says {entry.length}"
        raise rows.broken(f"episode {entry.index} has {count} rows, {said}")
    if "frame_index" in rows.table.column_names:
        wrong = np.flatnonzero(rows.column("frame_index") != np.arange(entry.length))
        if len(wrong):
            raise rows.broken("frame_index does not count from 0", row=int(wrong[0]))


SNAP_S = 1e-3
"""Stamps are 32-bit floats: closer than this to the grid they are on it."""
_UNSAFE = re.compile(r"[^A-Za-z0-9_]+")
MOST_OF_NAME = 60
"""Letters of an instruction that become the name of a task."""


@dataclass(kw_only=True)
class ImportReport:
    """What was brought in."""

    files: list[Path]
    frames: int
    already_there: int
    """Episodes that an earlier import of the same dataset wrote."""
    left_out: tuple[str, ...]
    """Features that have no place in an episode."""


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """Which feature goes to which topic."""

    joints: dict[str, str]
    cameras: dict[str, str]
    """Camera id by feature key."""
    left_out: tuple[str, ...]


def import_lerobot(
    folder: Path,
    run: RunFolder,
    *,
    cell: str,
    wanted: Sequence[range] | None,
    advance: Advance,
    task: str = "",
) -> ImportReport:
    """Write ``ep_000123.mcap`` for each wanted episode; those already written are passed over.

    Args:
        wanted: Numbers of episodes; None is all.
        task: Name of the task they are trials of; "": that which the dataset names for each.
    """
    info = layout.read_info(folder)
    plan = _plan(info, cell)
    entries = read_episodes(info, wanted)
    origin = {"dataset": folder.resolve().name, "info_sha256": hash_file(folder / layout.INFO_PATH)}
    stand_in = is_of_stand_in(folder)
    report = ImportReport(files=[], frames=0, already_there=0, left_out=plan.left_out)
    missing = [entry for entry in entries if not _is_there(run, entry, origin)]
    report.already_there = len(entries) - len(missing)
    for rows in iterate_rows(missing):
        about = replace(_about(info, rows, cell, task), stand_in=stand_in)
        path = _write(info, plan, rows, run, about, origin)
        report.files.append(path)
        report.frames += rows.entry.length
        advance(report.already_there + len(report.files), path.name)
    return report


def _episode_id(entry: EpisodeEntry) -> str:
    return f"ep_{entry.index:06d}"


def _is_there(run: RunFolder, entry: EpisodeEntry, origin: dict[str, str]) -> bool:
    path = run.episodes_dir / f"{_episode_id(entry)}.mcap"
    if not path.exists():
        return False
    source = Episode.open(path).metadata_records.get("source", {})
    if source.get("info_sha256") == origin["info_sha256"]:
        return True
    message = (
        f"{path} exists already and comes from another dataset. "
        "Import into another run folder, or move it away."
    )
    raise UsageError(message)


def _plan(info: DatasetInfo, cell: str) -> _Plan:
    joints: dict[str, str] = {}
    cameras: dict[str, str] = {}
    left_out = []
    for key, feature in info.features.items():
        if key in layout.DEFAULT_FEATURES:
            continue
        if feature.is_depth:
            left_out.append(f"{key} (depth)")
        elif feature.dtype in ("video", "image"):
            camera = _safe(key.removeprefix(layout.IMAGES).removeprefix("observation."))
            while camera in cameras.values():
                camera += "_"
            cameras[key] = camera
        elif feature.is_numeric_vector:
            joints[key] = (
                cell_topic(cell, JOINT_STATES) if key == layout.STATE else _topic(cell, key)
            )
        else:
            left_out.append(f"{key} ({feature.dtype} {list(feature.shape)})")
    return _Plan(joints=joints, cameras=cameras, left_out=tuple(left_out))


def _safe(text: str) -> str:
    return _UNSAFE.sub("_", text).strip("_") or "camera"


def _topic(cell: str, key: str) -> str:
    return f"/{cell}/" + "/".join(_safe(part) for part in key.split("."))


def _write(
    info: DatasetInfo,
    plan: _Plan,
    rows: EpisodeRows,
    run: RunFolder,
    about: EpisodeInfo,
    origin: dict[str, str],
) -> Path:
    entry, cell = rows.entry, about.cell
    stamps_ns = _stamps_ns(info, rows)
    columns = {key: _numbers(info, rows, key) for key in plan.joints}
    images = {key: _images(info, rows, key) for key in plan.cameras}
    writer = EpisodeWriter(run.episodes_dir / f"{_episode_id(entry)}.mcap")
    try:
        writer.describe(about, outcome=_outcome(rows))
        for number, stamp_ns in enumerate(stamps_ns.tolist()):
            for key, topic in plan.joints.items():
                sample = JointSample(
                    stamp_ns=stamp_ns,
                    names=info.features[key].names,
                    position=columns[key][number],
                    velocity=np.zeros(0),
                    effort=np.zeros(0),
                )
                writer.write(
                    topic, sample.to_cdr(), type_name=schema.JOINT_STATE, log_time_ns=stamp_ns
                )
            for key, camera in plan.cameras.items():
                _write_image(writer, camera_topic(cell, camera), stamp_ns, next(images[key]))
        writer.add_metadata("source", _source(info, plan, rows, origin))
        return writer.close()
    except BaseException:
        writer.discard()
        raise


def _write_image(writer: EpisodeWriter, prefix: str, stamp_ns: int, data: bytes) -> None:
    color = CompressedColor(
        stamp_ns=stamp_ns,
        frame_id=f"{prefix.rsplit('/', 1)[-1]}_color_optical",
        format="jpeg" if data[:2] == JPEG_MAGIC else "png",
        data=data,
    )
    writer.write(
        f"{prefix}{COLOR_IMAGE}",
        color.to_cdr(),
        type_name=schema.COMPRESSED_IMAGE,
        log_time_ns=stamp_ns,
    )


def _stamps_ns(info: DatasetInfo, rows: EpisodeRows) -> Int[np.ndarray, " num_rows"]:
    """Row times from 0; on the grid of ``fps`` unless the dataset says otherwise."""
    grid_s = np.arange(rows.entry.length) / info.fps
    if "timestamp" in rows.table.column_names:
        said_s = rows.column("timestamp").astype(np.float64)
        if not np.isfinite(said_s).all() or (said_s < 0).any() or (np.diff(said_s) <= 0).any():
            raise rows.broken(f"the timestamps of episode {rows.entry.index} do not rise")
        if (np.abs(said_s - grid_s) > SNAP_S).any():
            grid_s = said_s
    return np.array([ns_from_s(second) for second in grid_s.tolist()], dtype=np.int64)


def _numbers(
    info: DatasetInfo, rows: EpisodeRows, key: str
) -> Float[np.ndarray, "num_rows num_values"]:
    feature = info.features[key]
    if key not in rows.table.column_names:
        raise rows.broken(f"no column {key!r}, which {layout.INFO_PATH} lists")
    try:
        values = rows.column(key).astype(np.float64).reshape(rows.entry.length, -1)
    except (TypeError, ValueError) as error:
        raise rows.broken(f"column {key!r} holds no numbers ({error})") from error
    if values.shape[1] != feature.shape[0]:
        said = f"{layout.INFO_PATH} says {feature.shape[0]}"
        raise rows.broken(f"{key!r} has {values.shape[1]} numbers, {said}")
    return values


def _images(info: DatasetInfo, rows: EpisodeRows, key: str) -> Iterator[bytes]:
    if info.features[key].dtype == "video":
        span = rows.entry.videos[key]
        times_s = span.from_s + np.arange(rows.entry.length) / info.fps
        for image_u8 in read_frames(span.path, times_s.tolist(), 0.5 / info.fps):
            yield encode_jpeg(image_u8)
        return
    for number, value in enumerate(rows.table.column(key)):
        data = (value.as_py() or {}).get("bytes")
        if not data:
            hint = "Images outside the Parquet files are not read."
            raise rows.broken(f"{key!r} holds no image", row=number, hint=hint)
        yield data


def _about(info: DatasetInfo, rows: EpisodeRows, cell: str, task: str) -> EpisodeInfo:
    instruction = rows.entry.tasks[0] if rows.entry.tasks else ""
    return imported_info(
        _episode_id(rows.entry),
        task or _UNSAFE.sub("_", instruction.lower()).strip("_")[:MOST_OF_NAME],
        instruction=instruction,
        trial=rows.entry.index,
        robot=info.robot_type,
        cell=cell,
        tags=("lerobot",),
    )


def _outcome(rows: EpisodeRows) -> Outcome | None:
    if layout.SUCCESS not in rows.table.column_names:
        return None
    good = bool(np.asarray(rows.column(layout.SUCCESS), dtype=bool).any())
    return Outcome(result="success" if good else "failure", k=int(good), by="dataset next.success")


def _source(
    info: DatasetInfo, plan: _Plan, rows: EpisodeRows, origin: dict[str, str]
) -> dict[str, str]:
    videos = [key for key in plan.cameras if info.features[key].dtype == "video"]
    record: dict[str, Any] = {
        **origin,
        "format": f"LeRobotDataset {info.version}",
        "episode_index": rows.entry.index,
        "tasks": rows.entry.tasks,
        "fps": info.fps,
        "times": "nominal, from 0; the format keeps no clock",
        "units": "as in the dataset, not converted",
        "images": f"video frames re-encoded as JPEG q{JPEG_QUALITY}: {', '.join(videos) or 'none'}",
        "topics": {**plan.joints, **plan.cameras},
        "left_out": plan.left_out,
    }
    return {name: json.dumps(value) for name, value in record.items()}
