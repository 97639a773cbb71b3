"""What ``scene.json`` says: where the scene came from, how it was made, how good it is."""

import math
import resource
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from bridge.episode import provenance, streams
from twin.scene.dataset.training_set import TrainingSet
from twin.scene.fit.optimise import FitResult
from twin.scene.frames.camera_poses import SAYS
from twin.scene.frames.selection import FrameChoice, Sources, root_frame
from twin.scene.rebuild.views import MOST_DB
from twin.scene.settings import FrameConfig, RebuildConfig
from twin.scene.store.folder import BACKGROUND, SCENE_VERSION


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a rebuild took so far."""

    seconds: float
    """Wall time."""
    cpu_seconds: float
    """Of all threads."""
    stages_s: Mapping[str, float] = field(default_factory=dict)
    """Wall time of each stage."""

    def to_record(self) -> dict[str, Any]:
        """What ``scene.json`` says."""
        return {
            "seconds": round(self.seconds, 2),
            "cpu_seconds": round(self.cpu_seconds, 2),
            "peak_memory_mb": round(peak_memory_mb()),
            "stages_s": {name: round(seconds, 2) for name, seconds in self.stages_s.items()},
        }


def peak_memory_mb() -> float:
    """Most memory this process ever held resident, in 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


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
    cost: Cost,
) -> dict[str, Any]:
    """Put together the content of ``scene.json``."""
    settings = asdict(config)
    settings.pop("force")
    settings["fit"]["budget_s"] = None if math.isinf(config.fit.limit_s) else config.fit.limit_s
    scan = training.report.to_record()
    return {
        "schema_version": SCENE_VERSION,
        "key": key,
        "scene_hash": scene_hash,
        "frame": root_frame(training.choices[0]),
        "units": {"length": "m", "colour": "sRGB", "quaternion": "wxyz"},
        "remark": sources.remark,
        "stand_in": any(episode.info.stand_in for episode in sources.episodes),
        "sources": [
            {"id": e.info.id, "kind": e.info.kind, "sha256": e.sha256()} for e in sources.episodes
        ],
        "cameras": [camera_record(choice) for choice in training.choices],
        "scan": scan | {"remarks": [*left_out, *scan["remarks"]]},
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
            "coarse_iterations": fitted.coarse_iterations,
            "seconds": round(fitted.seconds, 2),
            "cpu_seconds": round(fitted.cpu_seconds, 2),
            "colour_steps": fitted.colour_steps,
            "train_psnr_db": None
            if fitted.train_psnr_db is None
            else round(min(fitted.train_psnr_db, MOST_DB), 3),
        },
        "views": dict(views),
        "cost": cost.to_record(),
        "seconds": round(cost.seconds, 2),
        "software": provenance.software(),
    }


def protocol_of(
    choices: Sequence[FrameChoice], fitted: FitResult, config: RebuildConfig, cost: Cost
) -> dict[str, Any]:
    """How the scene was made, as far as whoever rates its views must know."""
    frames = config.frames
    return {
        "holdout": holdout_text(frames),
        "training": training_text(frames),
        "train_frames": sum(len(choice.train_ns) for choice in choices),
        "cameras_from": sorted({SAYS[choice.poses.source] for choice in choices}),
        "num_splats": len(fitted.cloud),
        "fit_iterations": fitted.iterations,
        "underfitted": fitted.underfitted,
        "fit_seconds": round(fitted.seconds, 2),
        "fit_cpu_seconds": round(fitted.cpu_seconds, 2),
        "rebuild_seconds": round(cost.seconds, 2),
        "rebuild_cpu_seconds": round(cost.cpu_seconds, 2),
        "peak_memory_mb": round(peak_memory_mb()),
    }


def holdout_text(frames: FrameConfig) -> str:
    """Which frames were held out, in words."""
    return (
        f"frame {frames.first_holdout} and every {frames.holdout_every}th after it of each camera, "
        f"at most {frames.max_holdout_frames} in all"
    )


def training_text(frames: FrameConfig) -> str:
    """Which frames were trained on, in words."""
    if frames.train_every:
        return f"frame 0 and every {frames.train_every}th after it, but no held-out one"
    return "of the others the stillest and sharpest of each stretch of the camera's path"


def camera_record(choice: FrameChoice) -> dict[str, Any]:
    """What ``scene.json`` says about one camera of one episode."""
    camera = streams.camera_info(choice.episode, choice.camera_id).camera
    return {
        "episode": choice.episode.info.id,
        "id": choice.camera_id,
        "stationary": choice.stationary,
        "poses_from": choice.poses.source,
        "poses_quality": dict(choice.poses.quality),
        "frames_without_pose": len(choice.poses.unposed_ns),
        "train_frames": len(choice.train_ns),
        "holdout_frames": len(choice.holdout_ns),
        "color": asdict(camera),
    }


def describe_scene(record: Mapping[str, Any]) -> str:
    """Say in a few lines what was rebuilt and how well."""
    fitted, cost = record["fit"], record["cost"]
    lines = [
        f"scene {record['scene_hash']}: {record['background']['num_splats']} Gaussians"
        + (" (stand-in)" if record["stand_in"] else ""),
        f"fit: {_images_done(fitted)} in {fitted['seconds']:.1f} s"
        + (
            ""
            if fitted["train_psnr_db"] is None
            else f", training PSNR {fitted['train_psnr_db']:.2f} dB where nothing moved"
        ),
        f"took {cost['seconds']:.0f} s, {cost['cpu_seconds']:.0f} CPU seconds, "
        f"{cost['peak_memory_mb']} MB at most",
    ]
    lines += [
        f"camera {item['id']} of {item['episode']}: {item['train_frames']} training frames, "
        f"{item['holdout_frames']} held out; poses from {SAYS[item['poses_from']]}"
        for item in record["cameras"]
    ]
    lines += [
        f"{key}: {item['num_splats']} Gaussians, {item['num_completed']} where no view saw it"
        for key, item in record.get("objects", {}).items()
        if item.get("num_completed")
    ]
    if fitted.get("underfitted"):
        lines.insert(2, "underfitted: the time limit struck first; give --budget more time")
    lines.append(_view_line(record["views"]))
    lines += record["scan"]["remarks"]
    if record["remark"]:
        lines.append(record["remark"])
    return "\n".join(lines)


def _images_done(fitted: Mapping[str, Any]) -> str:
    asked = fitted.get("iterations_asked")  # not in scenes of older versions
    return (
        f"{fitted['iterations']} images"
        if asked is None
        else f"{fitted['iterations']} of {asked} images"
    )


def _view_line(views: Mapping[str, Any]) -> str:
    images = views["images"]
    if not images:
        return "no frame could be held out: too few frames"
    stationary = sum(bool(item["stationary_camera"]) for item in images)
    which = f", {stationary} of cameras that stand still" if stationary else ""
    return f"held-out views ({len(images)}{which}): PSNR {views['psnr_db']:.2f} dB"
