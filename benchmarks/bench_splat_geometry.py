"""Wrong geometry is found: ten errors of depth scale, focal length and delay in each recording.

A scan of the stand-in cell, the real kitchen and the real shelf, where they are at hand. The error
is put into what was recorded; the truth is the recording itself with the number that fits it best,
because real depth is off by some per cent and nobody knows how much.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from measure import ROOT, Target, report_targets

from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output
from twin.scene.dataset.geometry_search import (
    Correction,
    PoseAt,
    camera_pose_at,
    frame_ns_of,
    search_geometry,
)
from twin.scene.frames.downscaled import DownscaledDepth, downscaled_depth
from twin.scene.frames.selection import choose_frames, find_sources, load
from twin.scene.settings import FrameConfig

FACTORS = (0.5, 0.62, 0.75, 0.85, 0.9, 1.1, 1.15, 1.3, 1.6, 2.0)
DELAYS = (-6.0, -4.0, -2.5, -1.5, -1.0, 1.0, 1.5, 2.5, 4.0, 6.0)
"""In frames of the camera."""
LIMITS = {"depth": 2.0, "focal": 2.0, "delay": 1.0}
UNITS = {"depth": "%", "focal": "%", "delay": "frames"}
NOTE = "thumbnails of the training frames; worst of ten injected errors each; busy machine"

Wrong = Callable[[float], Correction | None]


def recordings(folder: Path) -> Iterator[tuple[str, RunFolder]]:
    """Those that are at hand."""
    sys.path.insert(0, str(ROOT / "benchmarks" / "splat"))
    import scans
    from kitchen import kitchen_folder

    yield "stand-in", scans.standin_scan(folder / "standin")
    for name, source in (("kitchen", kitchen_folder()), ("shelf", scans.shelf_folder())):
        if source is None:
            print(f"splat_geometry: no {name} here (GST_SHARED_DATA); its rows are left out")
        else:
            yield name, scans.shelf_scan(source, folder / name)


def moving_camera(run: RunFolder) -> tuple[list[DownscaledDepth], PoseAt, int]:
    """Thumbnails of the training frames of the first camera that moves, and its poses."""
    quiet = Output(quiet=True)
    choices = choose_frames(find_sources(run), FrameConfig(), quiet).choices
    choice = next(item for item in choices if not item.stationary)
    images = [downscaled_depth(frame, 120) for frame in load(choice, choice.train_ns)]
    images.sort(key=lambda image: image.stamp_ns)
    return images, camera_pose_at(choice), frame_ns_of(choice)


def injected(images: Sequence[DownscaledDepth], pose_at: PoseAt, frame_ns: int) -> dict[str, Wrong]:
    """By kind: what is found when that number is wrong by so much."""

    def depth(factor: float) -> Correction | None:
        wrong = [replace(i, depth_m=i.depth_m * np.float32(factor)) for i in images]
        return search_geometry(wrong, pose_at, frame_ns)

    def focal(factor: float) -> Correction | None:
        wrong = [
            replace(i, camera=replace(i.camera, fx=factor * i.camera.fx, fy=factor * i.camera.fy))
            for i in images
        ]
        return search_geometry(wrong, pose_at, frame_ns)

    def delay(frames: float) -> Correction | None:
        def late(stamp_ns: int) -> np.ndarray:
            return np.asarray(pose_at(round(stamp_ns - frames * frame_ns)))

        wrong = [replace(i, T_base_depth=late(i.stamp_ns)) for i in images]
        return search_geometry(wrong, late, frame_ns)

    return {"depth": depth, "focal": focal, "delay": delay}


def rows_of(name: str, run: RunFolder) -> list[Target]:
    images, pose_at, frame_ns = moving_camera(run)
    begun = time.process_time()
    right = search_geometry(images, pose_at, frame_ns)
    seconds = time.process_time() - begun
    rows = [
        Target(what=f"{name}: found in the recording as it is", measured=float(right is not None),
               limit=0.0, reference=f"{seconds:.1f} CPU seconds"),
    ]  # fmt: skip
    for kind, find in injected(images, pose_at, frame_ns).items():
        wanted = DELAYS if kind == "delay" else FACTORS
        found = [find(value) for value in wanted]
        same = [(v, f) for v, f in zip(wanted, found, strict=True) if f and f.kind == kind]
        if kind == "delay":
            errors = np.array([f.frames - v for v, f in same])
        else:
            errors = 100 * np.array([1 / (f.value * v) - 1 for v, f in same])
        silent = [f"{v:g}" for v, f in zip(wanted, found, strict=True) if f is None]
        own = float(np.median(errors)) if len(errors) else 0.0
        worst = float(np.abs(errors - own).max()) if len(errors) else float("inf")
        rows += [
            Target(what=f"{name}: {kind} found off by", measured=worst, limit=LIMITS[kind],
                   unit=UNITS[kind],
                   reference=f"worst of {len(same)} of {len(wanted)}; its own {own:+.2f}"),
            Target(what=f"{name}: {kind} errors not told",
                   measured=float(len(silent)), limit=0.0,
                   reference=", ".join(silent) or f"of {len(wanted)}"),
        ]  # fmt: skip
    return rows


def main() -> None:
    """Inject errors into each recording."""
    with tempfile.TemporaryDirectory() as folder:
        rows = [row for name, run in recordings(Path(folder)) for row in rows_of(name, run)]
    report_targets("splat_geometry", rows, note=NOTE)


if __name__ == "__main__":
    main()
