"""Starts of the stand-in cell as its cameras see them, in process: no recorder, no trial."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bridge.episode.streams import RgbdFrame
from bridge.geometry.camera import Camera
from bridge.media.color import decode_color, encode_jpeg
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.cell_file import draw_hidden, load_cell
from bridge.sources.standin.operator import STILL_S
from bridge.sources.standin.scan import joint_move, scan_joints
from bridge.sources.standin.streams import Streams
from bridge.task.task_file import Task, load_task

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from standin_hidden import nominal_hidden


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
    skins_m: dict[str, np.ndarray]
    """Vertices of the meshes of soft objects in the base frame, as they are deformed."""


class _Laboratory:
    """A cell with a start put down, and what it shows."""

    def __init__(
        self, task_name: str, seed: int, moved: Mapping[str, np.ndarray] | None, *, honest: bool
    ) -> None:
        self.task = load_task(task_name)
        self.file = load_cell(self.task.cell)
        self.tap = Tap({key: mount.camera for key, mount in self.file.cameras.items()})
        hidden = nominal_hidden(self.file) if honest else draw_hidden(self.file, seed)
        self.cell = StandinCell(self.file, self.task, hidden, self.tap, seed=seed, start_ns=0)
        self.cell.reset({**self.task.draw_start(np.random.default_rng(seed)), **(moved or {})})
        self.cell.announce()
        self.cell.wait(1.2 if moved else 0.4)

    def start(self) -> Start:
        world = self.cell.world
        Ts = world.Ts_base_object()
        return Start(
            task=self.task,
            frames=self.tap.frames,
            Ts_base_object=Ts,
            extents_m={key: world.extents_m(key, Ts[key]) for key in self.task.soft_objects},
            skins_m=world.skins_m(),
        )


def look_at_start(
    task_name: str,
    seed: int,
    count: int = 3,
    moved: Mapping[str, np.ndarray] | None = None,
    *,
    honest: bool = False,
) -> Start:
    """Draw a laboratory and a start, put the objects down and take a few frames of each camera.

    Args:
        count: Frames of each camera, 0.2 s apart, the arm at home.
        honest: The laboratory hides nothing: poses, joints and depth are right but for noise.
    """
    laboratory = _Laboratory(task_name, seed, moved, honest=honest)
    for _ in range(count):
        laboratory.cell.capture()
        laboratory.cell.wait(0.2)
    return laboratory.start()


def look_around(task_name: str, seed: int, *, honest: bool = False) -> Start:
    """Draw a laboratory and a start, and carry the wrist camera around it as a scan does.

    The side camera gives the first frame only: later the arm is in its way.
    """
    laboratory = _Laboratory(task_name, seed, None, honest=honest)
    cell, file = laboratory.cell, laboratory.file
    mount = next(item for item in file.cameras.values() if item.moving)
    joints = cell.home_rad
    cell.capture()
    for target in scan_joints(mount, cell.kinematics, joints):
        cell.follow(*joint_move(joints, target, file.max_joint_speed_rad_s))
        cell.wait(STILL_S)
        cell.capture()
        joints = target
    moving = {key for key, item in file.cameras.items() if item.moving}
    frames = laboratory.tap.frames
    first = min(frame.stamp_ns for frame in frames)
    frames[:] = [f for f in frames if f.camera_id in moving or f.stamp_ns == first]
    return laboratory.start()
