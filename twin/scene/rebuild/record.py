"""What ``scene.json`` says: where the scene came from, how it was made, how good it is."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from bridge.episode import provenance, streams
from twin.scene.dataset.training_set import TrainingSet
from twin.scene.fit.optimise import FitResult
from twin.scene.frames.camera_poses import SAYS
from twin.scene.frames.selection import FrameChoice, Sources, root_frame
from twin.scene.rebuild.views import MOST_DB
from twin.scene.settings import RebuildConfig
from twin.scene.store.folder import BACKGROUND, SCENE_VERSION


def make_record(
    *,
    key: str,
    scene_hash: str,
    sources: Sources,
    left_out: Sequence[str],
    training: TrainingSet,
    config: RebuildConfig,
    fitted: FitResult,
    views: Mapping[str, Any],
    num_background: int,
    num_completed: int,
    seconds: float,
) -> dict[str, Any]:
    """Put together the content of ``scene.json``."""
    settings = asdict(config)
    settings.pop("force")
    settings["fit"]["budget_s"] = None if math.isinf(config.fit.limit_s) else config.fit.limit_s
    return {
        "schema_version": SCENE_VERSION,
        "key": key,
        "scene_hash": scene_hash,
        "frame": root_frame(training.choices[0]),
        "remark": sources.remark,
        "stand_in": any(episode.info.stand_in for episode in sources.episodes),
        "sources": [
            {"id": e.info.id, "kind": e.info.kind, "sha256": e.sha256()} for e in sources.episodes
        ],
        "cameras": [camera_record(choice) for choice in training.choices],
        "scan": {"remarks": [*left_out, *training.report.remarks()]},
        "settings": settings,
        "background": {
            "file": BACKGROUND,
            "num_splats": num_background,
            "num_completed": num_completed,
        },
        "fit": {
            "num_splats": len(fitted.cloud),
            "iterations": fitted.iterations,
            "iterations_asked": fitted.iterations_asked,
            "underfitted": fitted.underfitted,
            "seconds": round(fitted.seconds, 2),
            "train_psnr_db": None
            if fitted.train_psnr_db is None
            else round(min(fitted.train_psnr_db, MOST_DB), 3),
        },
        "views": dict(views),
        "seconds": round(seconds, 2),
        "software": provenance.software(),
    }


def protocol_of(
    choices: Sequence[FrameChoice], fitted: FitResult, config: RebuildConfig
) -> dict[str, Any]:
    """How the scene was made, as far as whoever rates its views must know."""
    frames = config.frames
    training = "of the others, evenly along the camera's path"
    if frames.train_every:
        training = f"frame 0 and every {frames.train_every}th after it, but no held-out one"
    is_estimated = any(choice.estimated_m for choice in choices)
    estimated = "; depth was estimated from colour" if is_estimated else ""
    return {
        "holdout": f"frame {frames.holdout_every // 2} and every {frames.holdout_every}th after it "
        f"of each camera, at most {frames.max_holdout_frames} in all{estimated}",
        "training": training,
        "train_frames": sum(len(choice.train_ns) for choice in choices),
        "cameras_from": sorted({SAYS[choice.poses.source] for choice in choices}),
        "num_splats": len(fitted.cloud),
        "fit_iterations": fitted.iterations,
        "underfitted": fitted.underfitted,
    }


def camera_record(choice: FrameChoice) -> dict[str, Any]:
    """What ``scene.json`` says about one camera of one episode."""
    info = streams.camera_info(choice.episode, choice.camera_id)
    return {
        "episode": choice.episode.info.id,
        "id": choice.camera_id,
        "stationary": choice.stationary,
        "poses_from": choice.poses.source,
        "train_frames": len(choice.train_ns),
        "holdout_frames": len(choice.holdout_ns),
        "color": asdict(info.camera),
        **({} if info.lens is None else {"lens": info.lens.said}),
    }


def describe_scene(record: Mapping[str, Any]) -> str:
    """Say in a few lines what was rebuilt and how well."""
    fitted = record["fit"]
    asked = fitted["iterations_asked"]
    of_asked = "" if asked is None else f" of {asked}"
    lines = [
        f"scene {record['scene_hash']}: {record['background']['num_splats']} Gaussians"
        + (" (stand-in)" if record["stand_in"] else ""),
        f"fit: {fitted['iterations']}{of_asked} images in {fitted['seconds']:.1f} s"
        + (
            ""
            if fitted["train_psnr_db"] is None
            else f", training PSNR {fitted['train_psnr_db']:.2f} dB where nothing moved"
        ),
        f"took {record['seconds']:.0f} s",
    ]
    lines += [
        f"camera {item['id']} of {item['episode']}: {item['train_frames']} training frames, "
        f"{item['holdout_frames']} held out; poses from {SAYS[item['poses_from']]}"
        + (f"; {item['lens']}" if "lens" in item else "")
        for item in record["cameras"]
    ]
    lines += [
        f"{key}: {item['num_splats']} Gaussians, {item['num_completed']} where no view saw it"
        for key, item in record.get("objects", {}).items()
        if item.get("num_completed")
    ]
    if fitted["underfitted"]:
        lines.insert(2, "underfitted: the time limit struck first; give --budget more time")
    images = record["views"]["images"]
    stationary = sum(bool(item["stationary_camera"]) for item in images)
    which = f", {stationary} of cameras that stand still" if stationary else ""
    lines.append(
        f"held-out views ({len(images)}{which}): PSNR {record['views']['psnr_db']:.2f} dB"
        if images
        else "no frame could be held out: too few frames"
    )
    lines += record["scan"]["remarks"]
    if record["remark"]:
        lines.append(record["remark"])
    return "\n".join(lines)
