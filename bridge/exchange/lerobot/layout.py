"""The layout of a LeRobotDataset v3.0: where its files lie and what ``meta/info.json`` says.

Source: the format's documentation and the ``huggingface/lerobot`` repository (``datasets/utils.py``
for path templates and default features, ``dataset_metadata.py`` for the episode columns). Many
episodes share a data file and a video file; ``meta/episodes`` says where each lies. In version 2
each episode has files of its own, and ``meta/episodes.jsonl`` lists them.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bridge.clock import ClockChoice
from bridge.errors import BridgeError, PathNotFoundError, refuse_outside


@dataclass(frozen=True, kw_only=True)
class LeRobotConfig:
    """How a run becomes a dataset."""

    fps: int | None = None
    """Rows per second; the rate of the first camera if not given, 30 without cameras."""
    action: Literal["auto", "plan", "next-state"] = "auto"
    """plan: what the executed plan commands for the next row; auto: that if all trials have it."""
    episodes: tuple[str, ...] = ()
    """Only those with these ids, of any kind; or a pattern, rollouts in the twin too:
    `*.rollout.me.*`."""
    crf: int = 23
    """Quality of the H.264 video, lower is better."""
    clock: ClockChoice = "recorded"
    """corrected takes offset and drift of the sources' clocks out of all stamps."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense."""
        refuse_outside(self, {"fps": (1, 1000), "crf": (0, 51)})


VERSION = "v3.0"
INFO_PATH = "meta/info.json"
STATS_PATH = "meta/stats.json"
TASKS_PATH = "meta/tasks.parquet"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
EPISODES_PATH = f"meta/episodes/{FILE}.parquet"
DATA_PATH = f"data/{FILE}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{FILE}.mp4"
V2_FIELDS = {"{episode_chunk": "{chunk_index", "{episode_index": "{file_index"}
"""Fields of version 2's path templates as version 3 calls them."""
CHUNKS_SIZE = 1000
"""Files per chunk folder."""
DATA_FILE_MB = 100
VIDEO_FILE_MB = 200
STATE, ACTION, IMAGES = "observation.state", "action", "observation.images."
DONE, SUCCESS = "next.done", "next.success"
DEFAULT_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns every dataset has, with their type; all are scalars."""
_FIELD = re.compile(r"\{(\w+)(?::0?(\d+)d)?\}")


RESTORE = "Restore it from the original dataset."


class LeRobotFormatError(BridgeError):
    """A dataset does not look as its format says."""

    def __init__(self, *, path: Path, found: str, hint: str = RESTORE) -> None:
        """Remember the file and what was found."""
        self.path = path
        self.found = found
        super().__init__(f"{path}: {found}. {hint}")


@dataclass(frozen=True, kw_only=True)
class Feature:
    """One column or one camera."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    """One per number; made up where the dataset names none."""
    is_depth: bool = False
    """A video of depth, which has no place in an episode."""

    @property
    def is_numeric_vector(self) -> bool:
        """Whether it is a scalar or a vector of numbers."""
        numeric = self.dtype in ("bool",) or self.dtype.startswith(("float", "int", "uint"))
        return numeric and len(self.shape) == 1


@dataclass(frozen=True, kw_only=True)
class DatasetInfo:
    """``meta/info.json``, checked."""

    folder: Path
    fps: float
    robot_type: str
    data_path: str
    video_path: str
    features: dict[str, Feature]
    version: str
    episodes_per_chunk: int | None = None
    """Of version 2, where each episode has files of its own; None in version 3."""

    def file(self, template: str, **values: int | str) -> Path:
        """Fill in a path template; only plain fields, and never out of the folder."""

        def fill(match: re.Match[str]) -> str:
            value = values.get(match[1])
            if value is None:
                raise LeRobotFormatError(
                    path=self.folder / INFO_PATH,
                    found=f"path template {template!r} with the field {match[1]!r}",
                    hint=f"Version {VERSION} knows {', '.join(values)}.",
                )
            return f"{value:0{match[2]}d}" if match[2] and isinstance(value, int) else str(value)

        path = self.folder / _FIELD.sub(fill, template)
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise LeRobotFormatError(
                path=self.folder / INFO_PATH,
                found=f"path template {template!r} leads out of the dataset",
            )
        return path


def read_info(folder: Path) -> DatasetInfo:
    """Read and check ``meta/info.json``."""
    path = folder / INFO_PATH
    if not path.is_file():
        raise PathNotFoundError(
            path=path, what="LeRobot dataset", hint="Give the folder that holds meta/info.json."
        )
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        version = str(record["codebase_version"])
        if not version.startswith(("v2.", "v3.")):
            raise LeRobotFormatError(
                path=path,
                found=f"version {version}, and only v2 and v3 are read",
                hint="lerobot converts version 1: convert_dataset_v1_to_v2.",
            )
        fps = float(record["fps"])
        if not 0 < fps < 10_000:
            message = f"fps is {fps}"
            raise ValueError(message)
        features = {key: _feature(key, value) for key, value in record["features"].items()}
        places = [str(record.get(name) or "") for name in ("data_path", "video_path")]
        per_chunk = None
        if version.startswith("v2."):  # episode i is alone in file i of its chunk
            per_chunk = max(1, int(record.get("chunks_size") or CHUNKS_SIZE))
            for theirs, ours in V2_FIELDS.items():
                places = [place.replace(theirs, ours) for place in places]
        return DatasetInfo(
            folder=folder,
            fps=fps,
            robot_type=str(record.get("robot_type") or ""),
            data_path=places[0] or DATA_PATH,
            video_path=places[1] or VIDEO_PATH,
            features=features,
            version=version,
            episodes_per_chunk=per_chunk,
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise LeRobotFormatError(
            path=path, found=f"cannot be read ({type(error).__name__}: {error})"
        ) from error


def _feature(key: str, record: dict[str, Any]) -> Feature:
    shape = tuple(int(size) for size in record["shape"])
    names: list[str] = []
    if len(shape) == 1:
        names = _flat_names(record.get("names"))
        last = key.rsplit(".", 1)[-1]
        if len(names) != shape[0] or len(set(names)) != len(names):
            names = [last] if shape[0] == 1 else [f"{last}_{i}" for i in range(shape[0])]
    found = record.get("info") or record.get("video_info") or {}
    is_depth = any(found.get(name) is True for name in ("is_depth_map", "video.is_depth_map"))
    dtype = str(record["dtype"])
    return Feature(dtype=dtype, shape=shape, names=tuple(names), is_depth=is_depth)


def _flat_names(names: object) -> list[str]:
    """Names come as a list, as lists in a list, or under one key such as ``motors``."""
    if isinstance(names, str):
        return [names]
    if isinstance(names, dict):
        names = list(names.values())
    if isinstance(names, list):
        return [name for item in names for name in _flat_names(item)]
    return []


def parquet() -> tuple[Any, Any]:
    """Return ``pyarrow`` and ``pyarrow.parquet``; an extra brings them."""
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    return pa, pq
