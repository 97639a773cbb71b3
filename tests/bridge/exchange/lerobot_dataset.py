"""A small dataset in LeRobot's layouts, by hand, from the formats' descriptions alone."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

av = pytest.importorskip("av")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

FPS, WIDTH, HEIGHT = 10, 48, 32
LENGTHS = (7, 5, 9)
CAMERA = "observation.images.front"


def shade(index: int) -> np.ndarray:
    """The flat colour of the frame with this global index."""
    return np.array([20 + 9 * index, 240 - 9 * index, 128], dtype=np.uint8)


def state(index: int) -> list[float]:
    return [float(np.float32(0.1 * index)), float(np.float32(-index)), 0.5]


def write_video(path: Path, indices: list[int], codec: str = "libx264") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for index in indices:
            picture = np.broadcast_to(shade(index), (HEIGHT, WIDTH, 3))
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def png(index: int) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(np.broadcast_to(shade(index), (4, 6, 3)))).save(
        stream, "PNG"
    )
    return stream.getvalue()


class Dataset:
    """A v3.0 dataset: episodes 0 and 1 share files, episode 2 has files of its own."""

    def __init__(self, folder: Path) -> None:  # noqa: D107
        self.folder = folder
        self.info: dict[str, Any] = {
            "codebase_version": "v3.0",
            "robot_type": "so100",
            "total_episodes": 3,
            "total_frames": sum(LENGTHS),
            "total_tasks": 2,
            "chunks_size": 1000,
            "fps": FPS,
            "splits": {"train": "0:3"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": {
                "observation.state": {
                    "dtype": "float32",
                    "shape": [3],
                    "names": {"motors": ["pan", "lift", "grip"]},
                },
                "action": {"dtype": "float32", "shape": [3], "names": None},
                "observation.env": {"dtype": "float32", "shape": [2, 2], "names": None},
                CAMERA: {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": ["h", "w", "c"]},
                "observation.images.still": {"dtype": "image", "shape": [4, 6, 3], "names": None},
                "next.reward": {"dtype": "float32", "shape": [1], "names": None},
                "next.success": {"dtype": "bool", "shape": [1], "names": None},
                **{
                    key: {"dtype": dtype, "shape": [1], "names": None}
                    for key, dtype in (
                        ("timestamp", "float32"),
                        ("frame_index", "int64"),
                        ("episode_index", "int64"),
                        ("index", "int64"),
                        ("task_index", "int64"),
                    )
                },
            },
        }
        self.rows: list[dict[str, Any]] = []
        self.episodes: list[dict[str, Any]] = []
        first = 0
        for number, length in enumerate(LENGTHS):
            for frame in range(length):
                self.rows.append(self.row(number, frame, first + frame, frame == length - 1))
            start = 0.0 if number in (0, 2) else first / FPS
            self.episodes.append(
                {
                    "episode_index": number,
                    "tasks": ["fold the towel" if number == 2 else "pick the cube"],
                    "length": length,
                    "data/chunk_index": 0,
                    "data/file_index": number // 2,
                    "dataset_from_index": first,
                    "dataset_to_index": first + length,
                    f"videos/{CAMERA}/chunk_index": 0,
                    f"videos/{CAMERA}/file_index": number // 2,
                    f"videos/{CAMERA}/from_timestamp": start,
                    f"videos/{CAMERA}/to_timestamp": start + length / FPS,
                    "stats/action/min": [0.0, 0.0, 0.0],
                }
            )
            first += length

    def row(self, number: int, frame: int, index: int, last: bool) -> dict[str, Any]:
        return {
            "observation.state": state(index),
            "action": [value + 1 for value in state(index)],
            "observation.env": [[1.0, 2.0], [3.0, 4.0]],
            "observation.images.still": {"bytes": png(index), "path": None},
            "next.reward": float(last),
            "next.success": last and number != 1,
            "timestamp": frame / FPS,
            "frame_index": frame,
            "episode_index": number,
            "index": index,
            "task_index": number // 2,
        }

    def schema(self) -> Any:
        return pa.schema(
            [
                ("observation.state", pa.list_(pa.float32(), 3)),
                ("action", pa.list_(pa.float32())),
                ("observation.env", pa.list_(pa.list_(pa.float32()))),
                (
                    "observation.images.still",
                    pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
                ),
                ("next.reward", pa.float32()),
                ("next.success", pa.bool_()),
                ("timestamp", pa.float32()),
                ("frame_index", pa.int64()),
                ("episode_index", pa.int64()),
                ("index", pa.int64()),
                ("task_index", pa.int64()),
            ]
        )

    def write(self) -> Path:
        for file in (0, 1):
            rows = [row for row in self.rows if row["episode_index"] // 2 == file]
            path = self.folder / f"data/chunk-000/file-{file:03d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            # Small row groups that do not end where an episode does.
            table = pa.Table.from_pylist(rows, schema=self.schema())
            pq.write_table(table, path, row_group_size=4)
            video = self.folder / f"videos/{CAMERA}/chunk-000/file-{file:03d}.mp4"
            write_video(video, [row["index"] for row in rows])
        path = self.folder / "meta/episodes/chunk-000/file-000.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(self.episodes), path)
        (self.folder / "meta/info.json").write_text(json.dumps(self.info))
        return self.folder

    def write_v2(self) -> Path:
        """The same in v2.1: files of its own for each episode, lists in JSON lines."""
        chunk, number = "chunk-{episode_chunk:03d}", "episode_{episode_index:06d}"
        self.info |= {
            "codebase_version": "v2.1",
            "chunks_size": 2,
            "data_path": f"data/{chunk}/{number}.parquet",
            "video_path": f"videos/{chunk}/{{video_key}}/{number}.mp4",
        }
        lines = []
        for episode in self.episodes:
            index = episode["episode_index"]
            place = {"episode_chunk": index // 2, "episode_index": index, "video_key": CAMERA}
            rows = [row for row in self.rows if row["episode_index"] == index]
            path = self.folder / self.info["data_path"].format(**place)
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.Table.from_pylist(rows, schema=self.schema()), path)
            video = self.folder / self.info["video_path"].format(**place)
            write_video(video, [row["index"] for row in rows])
            lines.append({name: episode[name] for name in ("episode_index", "tasks", "length")})
        (self.folder / "meta").mkdir(exist_ok=True)
        listed = "".join(json.dumps(line) + "\n" for line in lines)
        (self.folder / "meta/episodes.jsonl").write_text(listed)
        (self.folder / "meta/info.json").write_text(json.dumps(self.info))
        return self.folder
