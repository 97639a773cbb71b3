"""SAM 3D Objects: one image, one mask, a whole shape; run as a program of its own.

It needs an environment that cannot be ours (CUDA, its own torch), so it is a subprocess with files
between us. ``docs/foundation_models.md`` states the contract and shows a worker.
"""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from bridge.errors import UsageError
from bridge.geometry.camera import Camera
from twin.errors import TwinError

OUTPUTS = ("mesh.glb", "splat.ply", "pose.json")
STDERR_TAIL_CHARACTERS = 1500
_POLL_S = 0.1


class GeneratorError(TwinError):
    """The generator failed, or what it left behind breaks the contract."""

    def __init__(self, *, found: str, stderr: str = "") -> None:
        """Remember the end of what the generator said."""
        self.stderr = stderr
        said = f" It said: {stderr}" if stderr else " It said nothing on its error output."
        super().__init__(
            f"the shape generator {found}. See the contract in docs/foundation_models.md.{said}"
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
    """Measured points in PyTorch3D's camera axes (x left, y up, z forward), NaN for none [m]."""
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
    said = work / "stderr.txt"
    try:
        with said.open("wb") as stderr:
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
    finally:
        _end_group(process)
    if not found and process.returncode < 0:
        found = f"was ended by signal {-process.returncode}"
    elif not found and process.returncode > 0:
        found = f"ended with exit code {process.returncode}"
    if found:
        raise GeneratorError(found=found, stderr=_tail(said))


def _end_group(process: "subprocess.Popen[bytes]") -> None:
    """Kill what is left of the program and of all it started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # nothing is left of it
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


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


def _check_output(out: Path, config: GeneratorConfig, said: str) -> None:
    if out.is_symlink() or not out.is_dir():
        raise GeneratorError(found="replaced its output folder", stderr=said)
    if _folder_bytes(out.parent) > config.max_output_bytes:
        found = f"wrote more than {config.max_output_bytes} bytes"
        raise GeneratorError(found=found, stderr=said)
    names = sorted(path.name for path in out.iterdir())
    for name in OUTPUTS:
        path = out / name
        if path.is_symlink():
            found = f"left {name} as a link, which is not followed"
            raise GeneratorError(found=found, stderr=said)
        if not path.is_file() or path.stat().st_size == 0:
            found = f"left no {name}; it left {', '.join(names) or 'nothing'}"
            raise GeneratorError(found=found, stderr=said)


def _tail(path: Path) -> str:
    """The end of a text file, on one line."""
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 4 * STDERR_TAIL_CHARACTERS))
        text = stream.read().decode("utf-8", "replace")
    words = "".join(c if c.isprintable() else " " for c in text).split()
    return " ".join(words)[-STDERR_TAIL_CHARACTERS:]


@dataclass(frozen=True, kw_only=True)
class CameraPose:
    """Where the generator believes its object to be."""

    T_camera_shape: Float[np.ndarray, "4 4"]
    """In OpenCV's camera axes; the shape has z up; scale first."""
    scale: float
    iou: float | None
    """How well its own layout step made mask and shape overlap, 0..1; None: it was not done."""
