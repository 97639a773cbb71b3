"""Episodes of a LeRobotDataset v3.0 as episodes of ours, one file each.

Times are nominal: row k is k / fps after 0, because the format keeps no clock. Numbers are kept as
they are, whatever their unit. Video frames become JPEG, which is one more lossy step and is said
so in the metadata ``source``; images inside the tables keep their bytes.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bridge.clock import ns_from_s
from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.provenance import hash_file
from bridge.episode.reader import Episode
from bridge.episode.records import CompressedColor, JointSample
from bridge.episode.run import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.exchange.lerobot import layout
from bridge.exchange.lerobot.layout import DatasetInfo, LeRobotFormatError, read_info
from bridge.exchange.lerobot.reader import (
    EpisodeEntry,
    EpisodeRows,
    iterate_rows,
    read_episodes,
)
from bridge.exchange.lerobot.video import read_frames
from bridge.media.color import JPEG_MAGIC, JPEG_QUALITY, encode_jpeg
from bridge.terminal import Advance

SNAP_S = 1e-3
"""Stamps are 32-bit floats: closer than this to the grid they are on it."""
_UNSAFE = re.compile(r"[^A-Za-z0-9_]+")


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
) -> ImportReport:
    """Write ``ep_000123.mcap`` for each wanted episode; those already written are passed over.

    Args:
        folder: The dataset.
        run: Where the episodes go.
        cell: Name of the cell in topics.
        wanted: Numbers of episodes; None is all.
        advance: Told how many episodes are done.

    Raises:
        LeRobotFormatError: Naming the file, and the row or frame, that cannot be believed.
        UsageError: When another episode with the same id is in the run.
    """
    info = read_info(folder)
    plan = _plan(info, cell)
    entries = read_episodes(info, wanted)
    origin = {"dataset": folder.resolve().name, "info_sha256": hash_file(folder / layout.INFO_PATH)}
    report = ImportReport(files=[], frames=0, already_there=0, left_out=plan.left_out)
    missing = [entry for entry in entries if not _is_there(run, entry, origin)]
    report.already_there = len(entries) - len(missing)
    for rows in iterate_rows(missing):
        path = _write(info, plan, rows, run, cell, origin)
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
        if feature.dtype in ("video", "image"):
            camera = _safe(key.removeprefix(layout.IMAGES).removeprefix("observation."))
            while camera in cameras.values():
                camera += "_"
            cameras[key] = camera
        elif feature.is_numeric_vector:
            joints[key] = f"/{cell}/joint_states" if key == layout.STATE else _topic(cell, key)
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
    cell: str,
    origin: dict[str, str],
) -> Path:
    entry = rows.entry
    stamps_ns = _stamps_ns(info, rows)
    columns = {key: _numbers(info, rows, key) for key in plan.joints}
    images = {key: _images(info, rows, key) for key in plan.cameras}
    writer = EpisodeWriter(run.episodes_dir / f"{_episode_id(entry)}.mcap")
    try:
        writer.describe(_about(info, rows, cell), outcome=_outcome(rows))
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
                _write_image(writer, f"/{cell}/cam/{camera}", stamp_ns, next(images[key]))
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
        f"{prefix}/color/image",
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
            raise LeRobotFormatError(
                path=rows.entry.data_path,
                found=f"row {rows.first_row}: the timestamps of episode {rows.entry.index} do "
                "not rise",
                hint="Restore the file from the original dataset.",
            )
        if (np.abs(said_s - grid_s) > SNAP_S).any():
            grid_s = said_s
    return np.array([ns_from_s(second) for second in grid_s.tolist()], dtype=np.int64)


def _numbers(
    info: DatasetInfo, rows: EpisodeRows, key: str
) -> Float[np.ndarray, "num_rows num_values"]:
    feature = info.features[key]
    if key not in rows.table.column_names:
        raise LeRobotFormatError(
            path=rows.entry.data_path,
            found=f"no column {key!r}, which {layout.INFO_PATH} lists",
            hint="Restore the file from the original dataset.",
        )
    try:
        values = rows.column(key).astype(np.float64).reshape(rows.entry.length, -1)
    except (TypeError, ValueError) as error:
        raise LeRobotFormatError(
            path=rows.entry.data_path,
            found=f"row {rows.first_row}: column {key!r} holds no numbers ({error})",
            hint="Restore the file from the original dataset.",
        ) from error
    if values.shape[1] != feature.shape[0]:
        raise LeRobotFormatError(
            path=rows.entry.data_path,
            found=f"row {rows.first_row}: {key!r} has {values.shape[1]} numbers, "
            f"{layout.INFO_PATH} says {feature.shape[0]}",
            hint="Restore the file from the original dataset.",
        )
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
            raise LeRobotFormatError(
                path=rows.entry.data_path,
                found=f"row {rows.first_row + number}: {key!r} holds no image",
                hint="Images outside the Parquet files are not read.",
            )
        yield data


def _about(info: DatasetInfo, rows: EpisodeRows, cell: str) -> EpisodeInfo:
    task = rows.entry.tasks[0] if rows.entry.tasks else ""
    return EpisodeInfo(
        id=_episode_id(rows.entry),
        kind="imported",
        task=task,
        instruction=task,
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
