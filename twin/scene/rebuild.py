"""Episodes in, scene out: choose frames, fuse, fit, render what was held out, store."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bridge.episode import provenance, streams
from bridge.episode.run import RunFolder
from bridge.terminal import Advance, Output
from twin.scene.fit import FitResult, fit
from twin.scene.frames import FrameChoice, Sources, choose_frames, find_sources, load
from twin.scene.gaussians import GaussianCloud
from twin.scene.initialise import fuse
from twin.scene.ply import write_ply
from twin.scene.points import DepthLimits, FrameSurface, PointSet
from twin.scene.raster import RasterConfig, load_native
from twin.scene.settings import RebuildConfig
from twin.scene.store import BACKGROUND, SCENE_VERSION, read_record, write_record
from twin.scene.training_view import TrainingView, training_view
from twin.scene.views import ViewNumbers, views_path, write_views

METHOD_VERSION = 1
"""Counts changes of method that make older scenes out of date."""
MAX_POINTS = 3_000_000
"""Depth points to fuse; more change nothing but the time."""


@dataclass(frozen=True, kw_only=True)
class _Learnt:
    """What the training frames gave."""

    points: list[PointSet]
    views: list[TrainingView]


def rebuild(run: RunFolder, config: RebuildConfig, output: Output) -> dict[str, Any]:
    """Rebuild the static scene of a run and return the content of ``scene.json``.

    Work already done with the same inputs and settings is not repeated unless forced.

    Raises:
        NoFramesError: When the run has no posed RGB-D frames.
        SplatExtensionMissingError: When the native code is not built.
    """
    load_native()
    sources = find_sources(run)
    if sources.remark:
        output.say(sources.remark)
    key = _key(sources, config)
    done = None if config.force else _already_done(run, sources, key)
    if done is not None:
        output.say("the scene is up to date (same episodes, same settings); --force redoes it")
        return done
    start = time.monotonic()
    choices = choose_frames(sources, config.frames)
    learnt = _learn(choices, config, output)
    first = fuse(learnt.points, config.initialise)
    output.say(f"{len(first)} Gaussians from {len(learnt.views)} training frames")
    with output.progress("fit", 100) as advance:
        result = fit(first, learnt.views, config.fit, advance)
    return _store(run, sources, choices, config, output, key, result, start)


def _key(sources: Sources, config: RebuildConfig) -> str:
    settings = asdict(config)
    settings.pop("force")
    settings["fit"].pop("threads")
    hashes = {str(e.path.name): provenance.hash_file(e.path) for e in sources.episodes}
    return provenance.hash_settings(
        {"method": METHOD_VERSION, "episodes": hashes, "settings": settings}
    )


def _already_done(run: RunFolder, sources: Sources, key: str) -> dict[str, Any] | None:
    record = read_record(run)
    if record is None or record.get("key") != key:
        return None
    complete = (run.scene_dir / BACKGROUND).is_file() and all(
        (run.derived_dir / name).is_file() for name in record["views"]["files"]
    )
    return record if complete else None


def _learn(choices: Sequence[FrameChoice], config: RebuildConfig, output: Output) -> _Learnt:
    total = sum(len(choice.train_ns) for choice in choices)
    learnt = _Learnt(points=[], views=[])
    limits = DepthLimits(
        max_depth_m=config.frames.max_depth_m, flying_fraction=config.initialise.flying_fraction
    )
    with output.progress("read frames", total) as advance:
        for choice in choices:
            for frame in load(choice, choice.train_ns):
                surface = FrameSurface(frame, limits)
                learnt.points.append(surface.points(_stride(total, frame.depth_m.size)))
                learnt.views.append(training_view(surface))
                advance(len(learnt.views), f"camera {frame.camera_id}")
    return learnt


def _stride(num_frames: int, num_pixels: int) -> int:
    """Use every n-th pixel of every n-th row so that all frames together stay within bounds."""
    return max(1, round(float(np.sqrt(num_frames * num_pixels / MAX_POINTS))))


def _store(
    run: RunFolder,
    sources: Sources,
    choices: Sequence[FrameChoice],
    config: RebuildConfig,
    output: Output,
    key: str,
    result: FitResult,
    start: float,
) -> dict[str, Any]:
    run.scene_dir.mkdir(parents=True, exist_ok=True)
    write_ply(run.scene_dir / BACKGROUND, result.cloud)
    scene_hash = provenance.hash_file(run.scene_dir / BACKGROUND)[:12]
    settings = asdict(config)
    total = sum(len(choice.holdout_ns) for choice in choices)
    with output.progress("render held-out views", total) as advance:
        numbers = _write_views(run, choices, result.cloud, scene_hash, config, advance)
    files = sorted({views_path(run, c.episode, scene_hash).name for c in choices if c.holdout_ns})
    _remove_stale_views(run, files, choices)
    record = {
        "schema_version": SCENE_VERSION,
        "key": key,
        "scene_hash": scene_hash,
        "frame": _root_frame(choices),
        "units": {"length": "m", "colour": "sRGB", "quaternion": "wxyz"},
        "remark": sources.remark,
        "stand_in": any(episode.info.stand_in for episode in sources.episodes),
        "sources": [
            {"id": e.info.id, "kind": e.info.kind, "sha256": provenance.hash_file(e.path)}
            for e in sources.episodes
        ],
        "cameras": [_camera_record(choice) for choice in choices],
        "settings": settings,
        "background": {"file": BACKGROUND, "num_splats": len(result.cloud)},
        "fit": {
            "iterations": result.iterations,
            "coarse_iterations": result.coarse_iterations,
            "seconds": round(result.seconds, 2),
            "cpu_seconds": round(result.cpu_seconds, 2),
            "train_psnr_db": round(result.train_psnr_db, 3),
        },
        "views": {"files": files, **_quality(numbers)},
        "seconds": round(time.monotonic() - start, 2),
        "software": provenance.software(),
    }
    write_record(run, record)
    return record


def _write_views(
    run: RunFolder,
    choices: Sequence[FrameChoice],
    cloud: GaussianCloud,
    scene_hash: str,
    config: RebuildConfig,
    advance: Advance,
) -> list[ViewNumbers]:
    return write_views(
        run,
        choices,
        cloud,
        scene_hash=scene_hash,
        settings={
            "holdout": f"every {config.frames.holdout_every}th frame of each camera",
            "resolution": "native colour camera",
            "masks": "none",
        },
        config=RasterConfig(threads=config.fit.threads),
        advance=advance,
    )


def _remove_stale_views(run: RunFolder, keep: list[str], choices: Sequence[FrameChoice]) -> None:
    """Views of an earlier scene show a place that is no longer stored."""
    for choice in choices:
        for path in run.derived_dir.glob(f"{choice.episode.path.stem}.views.*.mcap"):
            if path.name not in keep:
                path.unlink()


def _root_frame(choices: Sequence[FrameChoice]) -> str:
    choice = choices[0]
    info = streams.camera_info(choice.episode, choice.camera_id)
    return streams.transform_tree(choice.episode).root_of(info.frame_id)


def _camera_record(choice: FrameChoice) -> dict[str, Any]:
    camera = streams.camera_info(choice.episode, choice.camera_id).camera
    return {
        "episode": choice.episode.info.id,
        "id": choice.camera_id,
        "still": choice.still,
        "train_frames": len(choice.train_ns),
        "holdout_frames": len(choice.holdout_ns),
        "color": asdict(camera),
    }


def _quality(numbers: list[ViewNumbers]) -> dict[str, Any]:
    moving = [item for item in numbers if not item.still_camera]
    still = [item for item in numbers if item.still_camera]
    return {
        "note": "held out from initialisation and fit; PSNR is the mean of the images' values, "
        "native resolution, no masks, no colour alignment; the evaluator computes the official "
        "numbers from the views episode",
        "psnr_db": _mean([item.psnr_db for item in moving]),
        "psnr_db_still_cameras": _mean([item.psnr_db for item in still]),
        "depth_mean_abs_m": _mean(
            [item.depth_mean_abs_m for item in numbers if item.depth_mean_abs_m is not None]
        ),
        "images": [asdict(item) for item in numbers],
    }


def _mean(values: list[float]) -> float | None:
    return round(float(np.mean(values)), 4) if values else None


def describe_scene(record: dict[str, Any]) -> str:
    """Say in a few lines what was rebuilt and how well."""
    views, fitted = record["views"], record["fit"]
    lines = [
        f"scene {record['scene_hash']}: {record['background']['num_splats']} Gaussians"
        + (" (stand-in)" if record["stand_in"] else ""),
        f"fit: {fitted['iterations']} images in {fitted['seconds']:.1f} s, "
        f"training PSNR {fitted['train_psnr_db']:.2f} dB",
    ]
    held = len(views["images"])
    if views["psnr_db"] is not None:
        lines.append(f"held-out views of moving cameras: PSNR {views['psnr_db']:.2f} dB")
    if views["psnr_db_still_cameras"] is not None:
        lines.append(
            "later images of cameras that stand still (no new viewpoint): "
            f"PSNR {views['psnr_db_still_cameras']:.2f} dB"
        )
    if held == 0:
        lines.append("no frame could be held out: too few frames")
    if record["remark"]:
        lines.append(record["remark"])
    return "\n".join(lines)
