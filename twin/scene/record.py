"""What ``scene.json`` says: where the scene came from, how it was made, how good it is."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from bridge.episode import provenance, streams
from twin.scene.fit import FitResult
from twin.scene.frames import FrameChoice, Sources
from twin.scene.settings import RebuildConfig
from twin.scene.store import BACKGROUND, SCENE_VERSION
from twin.scene.views import ViewNumbers

VIEWS_NOTE = (
    "held out from initialisation and fit; means of the images' values; native resolution, "
    "no colour alignment; static_psnr_db leaves out pixels that show something that moved; "
    "the evaluator computes the official numbers from the views episode"
)


def make_record(
    *,
    key: str,
    scene_hash: str,
    sources: Sources,
    choices: Sequence[FrameChoice],
    config: RebuildConfig,
    fitted: FitResult,
    views: Mapping[str, Any],
    num_background: int,
    seconds: float,
) -> dict[str, Any]:
    """Put together the content of ``scene.json``."""
    settings = asdict(config)
    settings.pop("force")
    return {
        "schema_version": SCENE_VERSION,
        "key": key,
        "scene_hash": scene_hash,
        "frame": _root_frame(choices),
        "units": {"length": "m", "colour": "sRGB", "quaternion": "wxyz"},
        "remark": sources.remark,
        "stand_in": any(episode.info.stand_in for episode in sources.episodes),
        "sources": [
            {"id": e.info.id, "kind": e.info.kind, "sha256": e.sha256()} for e in sources.episodes
        ],
        "cameras": [_camera_record(choice) for choice in choices],
        "settings": settings,
        "background": {"file": BACKGROUND, "num_splats": num_background},
        "fit": {
            "iterations": fitted.iterations,
            "coarse_iterations": fitted.coarse_iterations,
            "seconds": round(fitted.seconds, 2),
            "cpu_seconds": round(fitted.cpu_seconds, 2),
            "train_psnr_db": None
            if fitted.train_psnr_db is None
            else round(fitted.train_psnr_db, 3),
        },
        "views": dict(views),
        "seconds": round(seconds, 2),
        "software": provenance.software(),
    }


def summarise_views(numbers: Sequence[ViewNumbers], files: Sequence[str]) -> dict[str, Any]:
    """Average the held-out views; cameras that stand still are kept apart."""
    moving = [item for item in numbers if not item.still_camera]
    still = [item for item in numbers if item.still_camera]
    return {
        "files": list(files),
        "note": VIEWS_NOTE,
        "psnr_db": _mean([item.psnr_db for item in moving]),
        "static_psnr_db": _mean([item.static_psnr_db for item in moving]),
        "psnr_db_still_cameras": _mean([item.psnr_db for item in still]),
        "static_psnr_db_still_cameras": _mean([item.static_psnr_db for item in still]),
        "depth_mean_abs_m": _mean([item.depth_mean_abs_m for item in numbers]),
        "images": [asdict(item) for item in numbers],
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 4) if known else None


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


def describe_scene(record: Mapping[str, Any]) -> str:
    """Say in a few lines what was rebuilt and how well."""
    views, fitted = record["views"], record["fit"]
    lines = [
        f"scene {record['scene_hash']}: {record['background']['num_splats']} Gaussians"
        + (" (stand-in)" if record["stand_in"] else ""),
        f"fit: {fitted['iterations']} images in {fitted['seconds']:.1f} s"
        + (
            ""
            if fitted["train_psnr_db"] is None
            else f", training PSNR {fitted['train_psnr_db']:.2f} dB where nothing moved"
        ),
    ]
    for ending, what in (
        ("", "held-out views of moving cameras"),
        ("_still_cameras", "held-out images of cameras that stand still (no new viewpoint)"),
    ):
        if views[f"psnr_db{ending}"] is None:
            continue
        line = f"{what}: PSNR {views[f'psnr_db{ending}']:.2f} dB"
        if views[f"static_psnr_db{ending}"] is not None:
            line += f", {views[f'static_psnr_db{ending}']:.2f} dB where nothing moved"
        lines.append(line)
    if not views["images"]:
        lines.append("no frame could be held out: too few frames")
    if record["remark"]:
        lines.append(record["remark"])
    return "\n".join(lines)
