"""Starts of the stand-in cell as its cameras see them, in process: no recorder, no trial."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bridge.episode.streams import RgbdFrame
from bridge.geometry.camera import Camera
from bridge.media.color import decode_color, encode_jpeg
from bridge.sources.standin.cell import CellConfig, StandinCell
from bridge.sources.standin.cell_file import load_cell
from bridge.sources.standin.hidden import draw_hidden
from bridge.sources.standin.streams import Streams
from bridge.task.task_file import Task, load_task


class _Nowhere:
    """A session that nobody listens to."""

    def publisher(self, topic: str, type_name: str, **_: object) -> "_Nowhere":
        return self

    def put(self, data: bytes, *, source_ns: int) -> None:
        pass

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        return b""


class Tap(Streams):
    """Keeps the frames instead of sending them, with the poses the cell believes in."""

    def __init__(self, cameras: dict[str, Camera]) -> None:
        """Know the intrinsics."""
        super().__init__(_Nowhere(), "standin")
        self._cameras = cameras
        self._poses: dict[str, np.ndarray] = {}
        self.frames: list[RgbdFrame] = []

    def camera_poses(self, poses: Mapping[str, np.ndarray], stamp_ns: int, *, static: bool) -> None:
        """Remember."""
        self._poses.update(poses)

    def frame(
        self, camera_id: str, image_u8: np.ndarray, depth_mm: np.ndarray, stamp_ns: int
    ) -> None:
        """Keep one frame, its colours through JPEG as on the wire."""
        camera, T = self._cameras[camera_id], self._poses[camera_id]
        self.frames.append(
            RgbdFrame(
                camera_id=camera_id,
                stamp_ns=stamp_ns,
                image_u8=decode_color(encode_jpeg(image_u8)),
                depth_m=(depth_mm * 1e-3).astype(np.float32),
                color_camera=camera,
                depth_camera=camera,
                T_base_color=T,
                T_base_depth=T,
            )
        )


@dataclass(frozen=True, kw_only=True)
class Start:
    """One start: what the cameras show, and what is true."""

    task: Task
    frames: list[RgbdFrame]
    Ts_base_object: dict[str, np.ndarray]
    extents_m: dict[str, np.ndarray]
    """Of soft objects, along the axes of their pose."""


def look_at_start(
    task_name: str,
    seed: int,
    count: int = 3,
    moved: Mapping[str, np.ndarray] | None = None,
) -> Start:
    """Draw a laboratory and a start, put the objects down and take a few frames of each camera.

    Args:
        task_name: A task of ``datasets/tasks``.
        seed: Draws what the laboratory hides, the start and the noise.
        count: Frames of each camera, 0.2 s apart, the arm at home.
        moved: Objects let go elsewhere, from where they fall.
    """
    task = load_task(task_name)
    file = load_cell(task.cell)
    tap = Tap({key: mount.camera for key, mount in file.cameras.items()})
    cell = StandinCell(
        file, task, draw_hidden(file, seed), tap, config=CellConfig(), seed=seed, start_ns=0
    )
    cell.reset({**task.draw_start(np.random.default_rng(seed)), **(moved or {})})
    cell.announce()
    cell.wait(1.2 if moved else 0.4)
    for _ in range(count):
        cell.capture()
        cell.wait(0.2)
    Ts = cell.world.Ts_base_object()
    extents = {key: cell.world.extents_m(key, Ts[key]) for key in task.soft_objects}
    return Start(task=task, frames=tap.frames, Ts_base_object=Ts, extents_m=extents)
