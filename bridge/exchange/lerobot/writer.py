"""Write a LeRobotDataset v3.0, one episode after another, with bounded memory."""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.exchange.lerobot import layout
from bridge.exchange.lerobot.layout import parquet
from bridge.media.video_writer import VideoWriter

PIXEL_STRIDE = 4
"""Image statistics look at every fourth pixel of both axes."""


@dataclass(kw_only=True)
class RunningStats:
    """Moments of rows of numbers: of columns, or of the pixels of images scaled to 0..1."""

    num_rows: int = 0
    num_images: int = 0
    low: Any = np.inf
    high: Any = -np.inf
    mean: Any = 0.0
    squares: Any = 0.0
    """Sum of squared distances from the mean (Welford; Chan et al. 1983 for merging)."""

    def add(self, rows: Float[np.ndarray, "num_rows num_values"]) -> None:
        """Add rows."""
        if not len(rows):
            return
        mean, low, high = rows.mean(axis=0), rows.min(axis=0), rows.max(axis=0)
        squares = ((rows - mean) ** 2).sum(axis=0)
        self.merge(RunningStats(num_rows=len(rows), low=low, high=high, mean=mean, squares=squares))

    def add_image(self, pixels: np.ndarray) -> None:
        """Add one image: height x width x 3 of uint8."""
        thinned = pixels[::PIXEL_STRIDE, ::PIXEL_STRIDE]
        self.add(thinned.reshape(-1, 3).astype(np.float64) / 255.0)
        self.num_images += 1

    def merge(self, other: "RunningStats") -> None:
        """Add everything another has seen."""
        num_rows, gap = self.num_rows + other.num_rows, other.mean - self.mean
        share = other.num_rows / max(num_rows, 1)
        self.squares = self.squares + other.squares + gap**2 * (self.num_rows * share)
        self.mean = self.mean + gap * share
        self.low, self.high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        self.num_rows, self.num_images = num_rows, self.num_images + other.num_images

    def record(self) -> dict[str, Any]:
        """Return what ``meta/stats.json`` holds: of a vector, or of a camera, channels first."""
        std = np.sqrt(self.squares / max(self.num_rows, 1))
        found = {"min": self.low, "max": self.high, "mean": self.mean, "std": std}
        shape = (3, 1, 1) if self.num_images else (-1,)
        shaped = {name: np.reshape(value, shape).tolist() for name, value in found.items()}
        return {**shaped, "count": [self.num_images or self.num_rows]}


MB = 1024 * 1024
FLUSH_EPISODES = 50


@dataclass(frozen=True, kw_only=True)
class DatasetShape:
    """What all episodes of a dataset share."""

    fps: int
    names: tuple[str, ...]
    """Joints of state and action."""
    cameras: dict[str, tuple[int, int]]
    """Height and width by camera."""
    robot_type: str
    labelled: bool
    """Whether ``next.success`` is written."""
    crf: int

    def features(self) -> dict[str, dict[str, Any]]:
        """Return the features of ``meta/info.json``, videos without their ``info``."""
        vector = {"dtype": "float32", "shape": [len(self.names)], "names": list(self.names)}
        features: dict[str, dict[str, Any]] = {
            layout.STATE: dict(vector),
            layout.ACTION: dict(vector),
        }
        for camera, (height, width) in self.cameras.items():
            features[layout.IMAGES + camera] = {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
            }
        flags = (layout.DONE, layout.SUCCESS) if self.labelled else (layout.DONE,)
        types = {**dict.fromkeys(flags, "bool"), **layout.DEFAULT_FEATURES}
        for key, dtype in types.items():
            features[key] = {"dtype": dtype, "shape": [1], "names": None}
        return features


@dataclass(kw_only=True)
class _Place:
    """Which file of a kind is being written."""

    chunk_index: int = 0
    file_index: int = 0

    def advance(self) -> None:
        self.file_index += 1
        if self.file_index == layout.CHUNKS_SIZE:
            self.chunk_index, self.file_index = self.chunk_index + 1, 0


@dataclass(kw_only=True)
class _Video:
    place: _Place = field(default_factory=_Place)
    writer: VideoWriter | None = None
    pix_fmt: str = ""


class DatasetWriter:
    """Append episodes to a new dataset; ``close`` writes what describes it as a whole."""

    def __init__(self, folder: Path, shape: DatasetShape) -> None:
        """Start a dataset in an empty folder."""
        self._arrow, self._parquet = parquet()
        self._folder = folder
        self._shape = shape
        self._tasks: dict[str, int] = {}
        self._num_frames = 0
        self._num_episodes = 0
        self._data_place = _Place()
        self._data: Any = None
        self._episodes: Any = None
        self._rows: list[dict[str, Any]] = []
        self._videos = {camera: _Video() for camera in shape.cameras}
        self._stats: dict[str, RunningStats] = {}

    def add(
        self,
        *,
        task: str,
        state: Float[np.ndarray, "num_rows num_joints"],
        action: Float[np.ndarray, "num_rows num_joints"],
        success: bool | None,
        images: Mapping[str, Iterable[np.ndarray]],
    ) -> None:
        """Append one episode.

        Args:
            success: Only written where all episodes are labelled.
        """
        length = len(state)
        columns = self._columns(task, state, action, success)
        stats: dict[str, RunningStats] = {}
        for key, values in columns.items():
            stats[key] = RunningStats()
            stats[key].add(values.astype(np.float64).reshape(length, -1))
        row: dict[str, Any] = {
            "episode_index": self._num_episodes,
            "tasks": [task],
            "length": length,
            **self._write_data(columns),
            "dataset_from_index": self._num_frames,
            "dataset_to_index": self._num_frames + length,
        }
        for camera, frames in images.items():
            row.update(self._write_video(camera, frames, stats))
        row.update({"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        for key, found in stats.items():
            row.update({f"stats/{key}/{name}": v for name, v in found.record().items()})
            self._stats.setdefault(key, RunningStats()).merge(found)
        self._rows.append(row)
        self._num_episodes += 1
        self._num_frames += length
        if len(self._rows) == FLUSH_EPISODES:
            self._flush_episodes()

    def _columns(
        self,
        task: str,
        state: Float[np.ndarray, "num_rows num_joints"],
        action: Float[np.ndarray, "num_rows num_joints"],
        success: bool | None,
    ) -> dict[str, np.ndarray]:
        length = len(state)
        number = np.arange(length, dtype=np.int64)
        task_index = self._tasks.setdefault(task, len(self._tasks))
        last = number == length - 1
        columns: dict[str, np.ndarray] = {
            layout.STATE: state.astype(np.float32),
            layout.ACTION: action.astype(np.float32),
            layout.DONE: last,
        }
        if self._shape.labelled:
            columns[layout.SUCCESS] = last & bool(success)
        columns["timestamp"] = (number / self._shape.fps).astype(np.float32)
        columns["frame_index"] = number
        columns["episode_index"] = np.full(length, self._num_episodes, dtype=np.int64)
        columns["index"] = number + self._num_frames
        columns["task_index"] = np.full(length, task_index, dtype=np.int64)
        return columns

    def _write_data(self, columns: dict[str, np.ndarray]) -> dict[str, int]:
        """Write one row group; start another file when this one is large enough."""
        pa = self._arrow
        arrays, names = [], []
        for key, values in columns.items():
            if values.ndim == 2:
                flat = pa.array(values.reshape(-1))
                arrays.append(pa.FixedSizeListArray.from_arrays(flat, values.shape[1]))
            else:
                arrays.append(pa.array(values))
            names.append(key)
        table = pa.table(arrays, names=names)
        place = self._data_place
        path = self._folder / layout.DATA_PATH.format(**vars(place))
        if self._data is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._data = self._parquet.ParquetWriter(path, table.schema, compression="snappy")
        self._data.write_table(table)
        used = {"data/chunk_index": place.chunk_index, "data/file_index": place.file_index}
        if path.stat().st_size >= layout.DATA_FILE_MB * MB:
            self._data.close()
            self._data = None
            place.advance()
        return used

    def _write_video(
        self,
        camera: str,
        frames: Iterable[np.ndarray],
        stats: dict[str, RunningStats],
    ) -> dict[str, int | float]:
        video, key = self._videos[camera], layout.IMAGES + camera
        if video.writer is None:
            path = self._folder / layout.VIDEO_PATH.format(video_key=key, **vars(video.place))
            height, width = self._shape.cameras[camera]
            shape = {"width": width, "height": height, "crf": self._shape.crf}
            video.writer = VideoWriter(path, fps=self._shape.fps, **shape)
            video.pix_fmt = video.writer.pix_fmt
        first = video.writer.num_frames
        found = RunningStats()
        for pixels in frames:
            video.writer.write(pixels, first=found.num_images == 0)
            found.add_image(pixels)
        stats[key] = found
        used: dict[str, int | float] = {
            f"videos/{key}/chunk_index": video.place.chunk_index,
            f"videos/{key}/file_index": video.place.file_index,
            f"videos/{key}/from_timestamp": first / self._shape.fps,
            f"videos/{key}/to_timestamp": video.writer.num_frames / self._shape.fps,
        }
        if video.writer.size_bytes >= layout.VIDEO_FILE_MB * MB:
            video.writer.close()
            video.writer = None
            video.place.advance()
        return used

    def _flush_episodes(self) -> None:
        if not self._rows:
            return
        table = self._arrow.Table.from_pylist(self._rows)
        if self._episodes is None:
            path = self._folder / layout.EPISODES_PATH.format(chunk_index=0, file_index=0)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._episodes = self._parquet.ParquetWriter(path, table.schema, compression="snappy")
        self._episodes.write_table(table)
        self._rows.clear()

    def close(self) -> None:
        """Finish all files and write tasks, statistics and ``meta/info.json``."""
        self._flush_episodes()
        self._close_files()
        self._write_tasks()
        stats = {key: found.record() for key, found in self._stats.items()}
        self._write_json(layout.STATS_PATH, stats)
        self._write_json(layout.INFO_PATH, self._info())

    def abandon(self) -> None:
        """Let go of open files after a failure; what they hold is of no use."""
        with suppress(Exception):  # the failure itself is the one to show
            self._close_files()

    def _close_files(self) -> None:
        for writer in (self._data, self._episodes):
            if writer is not None:
                writer.close()
        for video in self._videos.values():
            if video.writer is not None:
                video.writer.close()

    def _write_tasks(self) -> None:
        import pandas as pd  # noqa: PLC0415  # LeRobot reads the words as a pandas index

        tasks = pd.DataFrame(
            {"task_index": list(self._tasks.values())}, index=pd.Index(self._tasks, name="task")
        )
        tasks.to_parquet(self._folder / layout.TASKS_PATH)

    def _info(self) -> dict[str, Any]:
        features = self._shape.features()
        for camera, video in self._videos.items():
            height, width, channels = features[layout.IMAGES + camera]["shape"]
            features[layout.IMAGES + camera]["info"] = {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": video.pix_fmt,
                "video.is_depth_map": False,
                "video.fps": self._shape.fps,
                "video.channels": channels,
                "has_audio": False,
            }
        return {
            "codebase_version": layout.VERSION,
            "robot_type": self._shape.robot_type or None,
            "total_episodes": self._num_episodes,
            "total_frames": self._num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": layout.CHUNKS_SIZE,
            "data_files_size_in_mb": layout.DATA_FILE_MB,
            "video_files_size_in_mb": layout.VIDEO_FILE_MB,
            "fps": self._shape.fps,
            "splits": {"train": f"0:{self._num_episodes}"},
            "data_path": layout.DATA_PATH,
            "video_path": layout.VIDEO_PATH if self._videos else None,
            "features": features,
        }

    def _write_json(self, name: str, record: Mapping[str, Any]) -> None:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record, indent=4, ensure_ascii=False) + "\n", encoding="utf-8")
