"""SAM 3D Objects: one image, one mask, a whole shape; run as a program of its own.

It needs an environment that cannot be ours (CUDA, its own torch), so it is a subprocess with files
between us. ``docs/foundation_models.md`` states the contract and shows a worker.

The mesh in ``mesh.glb`` is y-up, the Gaussians in ``splat.ply`` and the pose are z-up; PyTorch3D's
camera looks along +z with x left and y up, and multiplies row vectors, so the stored quaternion
turns the other way round for columns.
"""

import contextlib
import json
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.errors import TwinError
from twin.scene.foundation.glb import read_glb
from twin.scene.foundation.metric_fit import MetricFit, MetricFitConfig, fit_metric
from twin.scene.gaussians import GaussianCloud, as_float32, moved_cloud, read_ply

OUTPUTS = ("mesh.glb", "splat.ply", "pose.json")
STDERR_TAIL_CHARACTERS = 1500
_POLL_S = 0.1


class GeneratorError(TwinError):
    """The generator failed, or what it left behind breaks the contract."""

    def __init__(self, *, found: str, stderr: str = "") -> None:
        """Remember the end of what the generator wrote."""
        self.stderr = stderr
        told = f" It wrote: {stderr}" if stderr else " It wrote nothing on its error output."
        super().__init__(
            f"the shape generator {found}. See the contract in docs/foundation_models.md.{told}"
        )


@dataclass(frozen=True, kw_only=True)
class GeneratorConfig:
    """How the generator is called."""

    command: tuple[str, ...]
    """Program and arguments; the paths of the input file and the output folder are appended."""
    timeout_s: float = 900.0
    """It is killed after this time, with every process it started."""
    max_output_bytes: int = 1_000_000_000
    """It is killed when the work folder grows beyond."""
    seed: int = 42
    """Passed on in the input file."""


@dataclass(frozen=True, kw_only=True)
class GeneratorInput:
    """One object in one image."""

    image_u8: UInt8[np.ndarray, "height width 3"]
    mask: Bool[np.ndarray, "height width"]
    """The object, in the same image."""
    depth_m: Float32[np.ndarray, "height width"]
    """Along the optical axis, in the same image; 0 or NaN where nothing was measured."""
    camera: Camera


def pointmap(
    depth_m: Float32[np.ndarray, "height width"], camera: Camera
) -> Float32[np.ndarray, "height width 3"]:
    """Measured points in PyTorch3D's camera axes (x left, y up, z forward), NaN for none [m].

    Args:
        depth_m: Along the optical axis; 0 is "not measured".
        camera: The depth camera; its frame has x right, y down, z forward.
    """
    points = camera.unproject(np.where(depth_m > 0, depth_m, np.nan).astype(np.float64))
    return np.asarray(points * np.array([-1.0, -1.0, 1.0]), dtype=np.float32)


def run_generator(wanted: GeneratorInput, work: Path, config: GeneratorConfig) -> Path:
    """Run the generator on one object and check the files it leaves.

    Args:
        wanted: What to complete.
        work: Folder that is made for this call alone; it must not exist yet.
        config: The command and its limits.

    Returns:
        The folder with ``mesh.glb``, ``splat.ply`` and ``pose.json``; their content is unchecked.

    Raises:
        UsageError: When the input is no object, or the command or the folder cannot be used.
        GeneratorError: When it fails, hangs, fills the disk or leaves other files than agreed.
    """
    _check_input(wanted)
    if not config.command or not config.timeout_s > 0 or work.exists():
        message = (
            f"the shape generator needs a command, a positive timeout and a new folder; found "
            f"{list(config.command)}, {config.timeout_s:g} s and {work}."
        )
        raise UsageError(message)
    work.mkdir(parents=True)
    work = work.resolve()
    out = work / "out"
    out.mkdir()
    _write_input(work / "in.npz", wanted, config.seed)
    command = [*config.command, str(work / "in.npz"), str(out)]
    _run(command, work, config)
    _check_output(out, config, _tail(work / "stderr.txt"))
    return out


def _check_input(wanted: GeneratorInput) -> None:
    size = (wanted.camera.height, wanted.camera.width)
    shapes = (wanted.image_u8.shape[:2], wanted.mask.shape, wanted.depth_m.shape)
    if any(shape != size for shape in shapes):
        message = f"image, mask and depth of sizes {shapes} do not fit a camera of {size}."
        raise UsageError(message)
    measured = int((wanted.mask & (wanted.depth_m > 0)).sum())
    if measured < 50:
        message = (
            f"the mask has {int(wanted.mask.sum())} pixels and {measured} with depth; a shape "
            "needs at least 50 measured pixels. Choose a nearer view."
        )
        raise UsageError(message)


def _write_input(path: Path, wanted: GeneratorInput, seed: int) -> None:
    camera = wanted.camera
    np.savez(
        path,
        rgb=wanted.image_u8,
        mask=wanted.mask,
        pointmap=pointmap(wanted.depth_m, camera),
        K=np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]),
        seed=np.int64(seed),
    )


def _run(command: Sequence[str], work: Path, config: GeneratorConfig) -> None:
    """Start the program as a process group of its own and watch time and disk."""
    written = work / "stderr.txt"
    try:
        with written.open("wb") as stderr:
            process = subprocess.Popen(
                command,
                cwd=work,
                stdin=subprocess.DEVNULL,
                stdout=stderr,
                stderr=stderr,
                start_new_session=True,
            )
    except OSError as error:
        message = f"the shape generator {command[0]!r} cannot be started ({error.strerror})."
        raise UsageError(message) from error
    found = ""
    deadline = time.monotonic() + config.timeout_s
    try:
        while process.poll() is None and not found:
            if time.monotonic() > deadline:
                found = f"was stopped after {config.timeout_s:g} s"
            elif _folder_bytes(work) > config.max_output_bytes:
                found = f"was stopped because it wrote more than {config.max_output_bytes} bytes"
            else:
                time.sleep(_POLL_S)
    finally:  # end what is left of the program and of all it started
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if not found and process.returncode < 0:
        found = f"was ended by signal {-process.returncode}"
    elif not found and process.returncode > 0:
        found = f"ended with exit code {process.returncode}"
    if found:
        raise GeneratorError(found=found, stderr=_tail(written))


def _folder_bytes(folder: Path) -> int:
    """Bytes below a folder, links not followed."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                total += (Path(place) / name).lstat().st_size
            except FileNotFoundError:
                continue  # the program is at work
    return total


def _check_output(out: Path, config: GeneratorConfig, stderr: str) -> None:
    if out.is_symlink() or not out.is_dir():
        raise GeneratorError(found="replaced its output folder", stderr=stderr)
    if _folder_bytes(out.parent) > config.max_output_bytes:
        found = f"wrote more than {config.max_output_bytes} bytes"
        raise GeneratorError(found=found, stderr=stderr)
    names = sorted(path.name for path in out.iterdir())
    for name in OUTPUTS:
        path = out / name
        if path.is_symlink():
            found = f"left {name} as a link, which is not followed"
            raise GeneratorError(found=found, stderr=stderr)
        if not path.is_file() or path.stat().st_size == 0:
            found = f"left no {name}; it left {', '.join(names) or 'nothing'}"
            raise GeneratorError(found=found, stderr=stderr)


def _tail(path: Path) -> str:
    """The end of a text file, on one line."""
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 4 * STDERR_TAIL_CHARACTERS))
        text = stream.read().decode("utf-8", "replace")
    words = "".join(c if c.isprintable() else " " for c in text).split()
    return " ".join(words)[-STDERR_TAIL_CHARACTERS:]


@dataclass(frozen=True, kw_only=True)
class CameraPose:
    """Where the generator puts its object."""

    T_camera_shape: Float[np.ndarray, "4 4"]
    """In OpenCV's camera axes; the shape has z up; scale first."""
    scale: float
    iou: float | None
    """How well its own layout step made mask and shape overlap, 0..1; None: it was not done."""


Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the axes of the glb file to those of the Gaussians and the pose."""
OPENCV_FROM_PYTORCH3D = np.diag([-1.0, -1.0, 1.0])
MIN_IOU = 0.2
"""A layout that overlaps its own mask less than this has failed (its errors are swallowed)."""
MAX_POSE_BYTES = 100_000


@dataclass(frozen=True, kw_only=True)
class GeneratedObject:
    """A generated shape, metric, in the root frame."""

    vertices_m: Float[np.ndarray, "num_vertices 3"]
    faces: Int[np.ndarray, "num_faces 3"]
    colors: Float32[np.ndarray, "num_vertices 3"] | None
    """0..1, sRGB as the generator stored them."""
    cloud: GaussianCloud
    fit: MetricFit
    iou: float | None
    """The generator's own measure of its layout; None: it gave none."""
    source: str


def generate_object(
    wanted: GeneratorInput,
    T_base_camera: Float[np.ndarray, "4 4"],
    support_z_m: float | None,
    work: Path,
    config: GeneratorConfig,
    fit: MetricFitConfig | None = None,
) -> GeneratedObject:
    """Complete one object from one view, and give it the size and place that depth says.

    Args:
        wanted: Image, mask, depth and camera.
        T_base_camera: Where the image was taken, z of the root frame up.
        support_z_m: Height of what the object stands on; None: unknown.
        work: New folder for the generator's files.
        config: Command and limits.
        fit: Settings of the registration; the defaults when None.

    Raises:
        UsageError: When the input is no object or the command cannot be started.
        GeneratorError: When the generator fails or breaks the contract.
        UnreadableGlbError: When its mesh cannot be read.
        UnreadablePlyError: When its Gaussians cannot be read.
        MetricFitError: When its shape does not lie on the measured points.
    """
    out = run_generator(wanted, work, config)
    depth = np.where(wanted.mask & (wanted.depth_m > 0), wanted.depth_m, np.nan)
    points_camera = wanted.camera.unproject(depth.astype(np.float64)).reshape(-1, 3)
    points_camera = points_camera[np.isfinite(points_camera).all(axis=1)]
    return lay_down(
        out,
        se3.apply(T_base_camera, points_camera),
        T_base_camera,
        support_z_m,
        fit or MetricFitConfig(),
        source=f"generated by {Path(config.command[0]).name}",
    )


def lay_down(
    out: Path,
    points_m: Float[np.ndarray, "num_points 3"],
    T_base_camera: Float[np.ndarray, "4 4"],
    support_z_m: float | None,
    config: MetricFitConfig,
    *,
    source: str,
) -> GeneratedObject:
    """Read a generator's files and register them with points measured in the root frame.

    Args:
        out: Folder with the generator's ``pose.json``, ``mesh.glb`` and ``splat.ply``.
        points_m: Measured points of the object, root frame.
        T_base_camera: Where the camera of the generator's image was.
        support_z_m: Height of what the object stands on; None: unknown.
        config: How the shape is laid onto the points.
        source: Which program made it, for the record.
    """
    pose = read_pose(out / "pose.json")
    mesh = read_glb(out / "mesh.glb")
    vertices = mesh.vertices @ Z_UP_FROM_Y_UP.T
    cloud = read_ply(out / "splat.ply")
    fitted = fit_metric(
        vertices,
        mesh.faces,
        points_m,
        [T_base_camera[:3, 3]],
        T_base_camera @ pose.T_camera_shape,
        pose.scale,
        support_z_m,
        config,
    )
    return GeneratedObject(
        vertices_m=fitted.apply(vertices),
        faces=mesh.faces,
        colors=mesh.colors,
        cloud=scaled_cloud(cloud, fitted.scale, fitted.T_base_shape),
        fit=fitted,
        iou=pose.iou,
        source=source,
    )


def scaled_cloud(
    cloud: GaussianCloud, scale: float, T_new_old: Float[np.ndarray, "4 4"]
) -> GaussianCloud:
    """The same Gaussians after growing by a factor and then moving rigidly.

    Args:
        cloud: The Gaussians before.
        scale: Factor on positions and sizes, about the origin of the old frame.
        T_new_old: The motion that follows.
    """
    grown = replace(
        cloud,
        means_m=as_float32(cloud.means_m * scale),
        scales_log=as_float32(cloud.scales_log + np.log(scale)),
    )
    return moved_cloud(grown, T_new_old)


def read_pose(path: Path) -> CameraPose:
    """Read ``pose.json``: rotation_wxyz, translation, scale, and iou if there is one.

    Raises:
        GeneratorError: When it is broken, or says that the layout failed.
    """
    if path.stat().st_size > MAX_POSE_BYTES:
        raise GeneratorError(found="wrote a pose.json that is too large")
    try:
        content = json.loads(path.read_bytes())
        q = _numbers(content, "rotation_wxyz", 4)
        p = _numbers(content, "translation", 3)
        scale = _scale(content)
        iou = None if content.get("iou") is None else float(content["iou"])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        found = f"wrote a pose.json that cannot be used ({type(error).__name__}: {error})"
        raise GeneratorError(found=found) from error
    if not np.linalg.norm(q) > 1e-6 or not scale > 0.0:
        raise GeneratorError(found=f"wrote a pose without a rotation or a size (scale {scale:g})")
    if iou is not None and not iou >= MIN_IOU:
        found = f"says that its layout failed (iou {iou:.2f}, at least {MIN_IOU} is needed)"
        raise GeneratorError(found=found)
    T = np.eye(4)
    T[:3, :3] = OPENCV_FROM_PYTORCH3D @ se3.rotation_from_quaternion(q).T
    T[:3, 3] = OPENCV_FROM_PYTORCH3D @ p
    # Two mirrored axes are a half turn, so the product is a rotation again.
    return CameraPose(T_camera_shape=T, scale=scale, iou=iou)


def _numbers(content: dict[str, Any], name: str, count: int) -> np.ndarray:
    values = np.array(content[name], dtype=np.float64).reshape(-1)
    if len(values) != count or not np.isfinite(values).all():
        message = f"{name} is not {count} finite numbers"
        raise ValueError(message)
    return values


def _scale(content: dict[str, Any]) -> float:
    """One number, or three alike."""
    values = np.array(content["scale"], dtype=np.float64).reshape(-1)
    if len(values) not in (1, 3) or not np.isfinite(values).all():
        message = "scale is not one finite number or three"
        raise ValueError(message)
    if np.ptp(values) > 0.02 * abs(float(values.mean())):
        message = f"scale {values.tolist()} differs between axes, which no rigid object does"
        raise ValueError(message)
    return float(values.mean())
