"""Episodes in, scene out: choose frames, fuse, fit, render what was held out, store."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bridge.episode import provenance
from bridge.episode.run import RunFolder
from bridge.errors import UsageError
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin.scene.fit import fit
from twin.scene.fit_state import FIT_STATE, Checkpoint
from twin.scene.frames import (
    FrameChoice,
    NoFramesError,
    Sources,
    choose_frames,
    find_sources,
    load,
)
from twin.scene.initialise import fuse
from twin.scene.moving import MovingVoxels, Witness, choose_witnesses, find_moving
from twin.scene.parts import episode_of_task, take_apart
from twin.scene.ply import write_ply
from twin.scene.points import DepthLimits, FrameSurface, PointSet
from twin.scene.raster import RasterConfig, load_native
from twin.scene.record import make_record, summarise_views
from twin.scene.settings import RebuildConfig
from twin.scene.store import (
    BACKGROUND,
    SCENE_FILE,
    background_hash,
    read_record,
    write_record,
)
from twin.scene.training_view import TrainingView, training_view
from twin.scene.views import ViewsJob, views_path, write_views

METHOD_VERSION = 7
"""Counts changes of method that make older scenes out of date."""
MAX_POINTS = 3_000_000
"""Depth points to fuse; more change nothing but the time."""


@dataclass(frozen=True, kw_only=True)
class _Learnt:
    """What the training frames gave."""

    points: list[PointSet]
    views: list[TrainingView]
    moving: MovingVoxels
    witnesses: list[Witness]


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
    done = None if config.force else _already_done(run, key)
    if done is not None:
        output.say("the scene is up to date (same episodes, same settings); --force redoes it")
        return done
    start = time.monotonic()
    choices = choose_frames(sources, config.frames)
    learnt = _learn(choices, config, output)
    output.detail(f"{len(learnt.moving.keys)} voxels hold something that moved")
    first = fuse(learnt.points, config.initialise)
    output.say(f"{len(first)} Gaussians from {len(learnt.views)} training frames")
    run.scene_dir.mkdir(parents=True, exist_ok=True)
    kept = Checkpoint(path=run.scene_dir / FIT_STATE, key=key)
    if config.force:
        kept.path.unlink(missing_ok=True)
    with output.progress("fit", 100) as advance:
        fitted = fit(
            first,
            learnt.views,
            config.fit,
            advance,
            max_splats=config.initialise.max_splats,
            checkpoint=kept,
        )
    (run.scene_dir / SCENE_FILE).unlink(missing_ok=True)  # it vouches for the files below
    apart = take_apart(sources, fitted.cloud, choices)
    if apart.remark:
        output.say(apart.remark)
    write_ply(run.scene_dir / BACKGROUND, apart.background)
    scene_hash = background_hash(run)
    job = ViewsJob(
        scene_hash=scene_hash,
        cloud=fitted.cloud,
        witnesses=learnt.witnesses,
        limits=_limits(config),
        holdout_every=config.frames.holdout_every,
        raster=RasterConfig(threads=config.fit.threads),
    )
    with output.progress("render held-out views", _num_holdout(choices)) as advance:
        numbers = write_views(run, choices, job, advance)
    files = _remove_stale_views(run, choices, scene_hash)
    record = make_record(
        key=key,
        scene_hash=scene_hash,
        sources=sources,
        choices=choices,
        config=config,
        fitted=fitted,
        views=summarise_views(numbers, files),
        num_background=len(apart.background),
        seconds=time.monotonic() - start,
    )
    record |= apart.write(run)
    write_record(run, record)
    kept.path.unlink(missing_ok=True)
    return record


def _key(sources: Sources, config: RebuildConfig) -> str:
    settings = asdict(config)
    settings.pop("force")
    settings["fit"].pop("threads")
    hashes = {str(e.path.name): e.sha256() for e in sources.episodes}
    return provenance.hash_settings(
        {
            "method": METHOD_VERSION,
            "episodes": hashes,
            "settings": settings,
            "task": _task_content(sources),
        }
    )


def _task_content(sources: Sources) -> dict[str, Any] | None:
    """Shapes and colours decide the objects; a task that cannot be read gives none."""
    episode = episode_of_task(sources)
    try:
        return None if episode is None else asdict(load_task(episode.info.task))
    except UsageError:
        return None


def _already_done(run: RunFolder, key: str) -> dict[str, Any] | None:
    record = read_record(run)
    if record is None or record.get("key") != key:
        return None
    needed = [run.scene_dir / BACKGROUND]
    needed += [run.derived_dir / name for name in record["views"]["files"]]
    needed += [
        run.scene_dir / item["folder"] / name
        for item in record.get("objects", {}).values()
        for name in item["files"]
    ]
    whole = all(path.is_file() for path in needed)
    return record if whole and background_hash(run) == record["scene_hash"] else None


def _learn(choices: Sequence[FrameChoice], config: RebuildConfig, output: Output) -> _Learnt:
    total = sum(len(choice.train_ns) for choice in choices)
    points: list[PointSet] = []
    views: list[TrainingView] = []
    with output.progress("read frames", total) as advance:
        for choice in choices:
            for frame in load(choice, choice.train_ns):
                surface = FrameSurface(frame, _limits(config))
                points.append(surface.points(_stride(total, frame.depth_m.size)))
                views.append(training_view(surface))
                advance(len(views), f"camera {frame.camera_id}")
    if not views:
        message = "no frame of this run has colour, depth and a pose together. Record it again."
        raise NoFramesError(message)
    witnesses = choose_witnesses(views)
    moving = find_moving(points, witnesses)
    return _Learnt(
        points=[moving.drop_from(item) for item in points],
        views=[moving.mask_in(view) for view in views],
        moving=moving,
        witnesses=witnesses,
    )


def _stride(num_frames: int, num_pixels: int) -> int:
    """Use every n-th pixel of every n-th row so that all frames together stay within bounds."""
    return max(1, round(float(np.sqrt(num_frames * num_pixels / MAX_POINTS))))


def _limits(config: RebuildConfig) -> DepthLimits:
    return DepthLimits(
        max_depth_m=config.frames.max_depth_m, flying_fraction=config.initialise.flying_fraction
    )


def _num_holdout(choices: Sequence[FrameChoice]) -> int:
    return sum(len(choice.holdout_ns) for choice in choices)


def _remove_stale_views(
    run: RunFolder, choices: Sequence[FrameChoice], scene_hash: str
) -> list[str]:
    """Remove the views of earlier scenes, which are no longer stored; return the present ones."""
    present = {views_path(run, c.episode, scene_hash).name for c in choices if c.holdout_ns}
    for path in run.derived("*.views.*"):
        if path.name not in present:
            path.unlink()
    return sorted(present)
