"""Episodes in, scene out: choose frames, fuse, fit, render what was held out, store.

The order of things is here; each stage lives in a module of its own. Nothing that is learnt from
sees a held-out frame. A new scene takes the old one's place when it is whole.
"""

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bridge.episode import provenance
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, refuse_full
from bridge.errors import BridgeError
from bridge.leaves import has_leaf, load_leaf
from bridge.terminal import Output
from twin.scene.backdrop import Backdrop, backdrop_of
from twin.scene.dataset.training_set import TrainingSet, read_training_set
from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import FitResult, fit
from twin.scene.frames.selection import Sources, choose_frames, find_sources
from twin.scene.gaussians import write_ply
from twin.scene.objects.decompose import Decomposition, decompose
from twin.scene.objects.placement import find_placements, scanned_tasks
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, load_native
from twin.scene.rebuild.record import make_record, protocol_of
from twin.scene.rebuild.views import ENGINE, ViewsJob, summarise_views, views_path, write_views
from twin.scene.robot.extraction import LitLinks, write_robot
from twin.scene.settings import DEFAULT_BUDGET_S, RebuildConfig
from twin.scene.store.calibration import Calibration, read_calibration
from twin.scene.store.folder import (
    BACKGROUND,
    background_hash,
    read_record,
    scene_beside,
    write_record,
)

METHOD_VERSION = 33
"""Counts changes of method that make older scenes out of date."""
SEARCHED_SPLATS = 80_000
"""Points of the fused surface in which things are looked for, at most."""


def rebuild(run: RunFolder, config: RebuildConfig, output: Output) -> dict[str, Any]:
    """Rebuild the static scene of a run and return the content of ``scene.json``.

    Work already done with the same inputs and settings is not repeated unless forced.
    """
    load_native()
    sources = find_sources(run)
    if sources.remark:
        output.say(sources.remark)
    calibration = read_calibration(run)
    models: dict[str, str] = {}
    if config.models.any_named:
        models = load_leaf("perception", "check_models")(config.models, scanned_tasks(sources).task)
    key = _key(sources, config, calibration, models)
    done = None if config.force else _already_done(run, key)
    if done is not None:
        output.say("the scene is up to date (same episodes, same settings); --force redoes it")
        return done
    refuse_full(run.scene_dir)
    began_s = time.monotonic()
    chosen = choose_frames(sources, config.frames, output, calibration)
    if not all(choice.has_depth for choice in chosen.choices):
        estimate = load_leaf("depth from colour", "estimate")
        chosen = estimate(chosen, config.frames.max_depth_m, output)
    placements = find_placements(sources, chosen.choices, output)
    training = read_training_set(chosen.choices, config, output, placements)
    fitted = _fit(training, config, output)
    links = training.robot.links(config.initialise.max_splats)
    decomposed = decompose(placements, fitted.cloud, training.views_of, output, links.lighting)
    rasteriser = Rasteriser(RasterConfig(threads=config.fit.threads))
    backdrop = backdrop_of(fitted.cloud, training.bare_views, rasteriser)
    with scene_beside(run) as new:
        write_ply(new.scene_dir / BACKGROUND, decomposed.background)
        views = _hold_out(new, training, fitted, backdrop, decomposed, links, config, output)
        extras = _write_parts(new, sources, training, decomposed, links, config, output)
        record = make_record(
            key=key,
            scene_hash=background_hash(new),
            sources=sources,
            left_out=chosen.left_out,
            training=training,
            config=config,
            fitted=fitted,
            views=views,
            num_background=len(decomposed.background),
            num_completed=int(decomposed.background.completed.sum()),
            seconds=time.monotonic() - began_s,
        )
        record |= extras | {"backdrop": backdrop.write(new.scene_dir)}
        write_record(new, record)
    for path in run.derived("*.views.*"):  # ours of earlier scenes; others are compared with ours
        if path.name not in views["files"] and _is_ours(path):
            path.unlink()
    return record


def _fit(training: TrainingSet, config: RebuildConfig, output: Output) -> FitResult:
    began_s = time.monotonic()
    first = fuse(training.bare_points, config.initialise.first_splats, training.bare_views)
    output.say(f"{len(first)} Gaussians from {len(training.views)} training frames")
    with output.progress("fit", 100) as advance:
        return fit(
            first,
            training.bare_views,
            config.fit,
            advance,
            max_splats=config.initialise.max_splats,
            spent_s=time.monotonic() - began_s,
        )


def _hold_out(
    run: RunFolder,
    training: TrainingSet,
    fitted: FitResult,
    backdrop: Backdrop,
    decomposed: Decomposition,
    links: LitLinks,
    config: RebuildConfig,
    output: Output,
) -> dict[str, Any]:
    """Render what was held out, and say how well it came out."""
    choices = training.choices
    job = ViewsJob(
        training=training,
        scenes=decomposed,
        links=links,
        backdrop=backdrop,
        config=config,
        protocol=protocol_of(choices, fitted, config),
    )
    total = sum(len(choice.holdout_ns) for choice in choices)
    with output.progress("render held-out views", total) as advance:
        numbers = write_views(run, job, advance)
    scene_hash = background_hash(run)
    present = {views_path(run, c.episode, scene_hash).name for c in choices if c.holdout_ns}
    return summarise_views(numbers, sorted(present))


def _write_parts(
    run: RunFolder,
    sources: Sources,
    training: TrainingSet,
    decomposed: Decomposition,
    links: LitLinks,
    config: RebuildConfig,
    output: Output,
) -> dict[str, Any]:
    """Write objects, robot links, distances and semantics; return what ``scene.json`` says."""
    output.say("write objects, robot links and the distances to what is static")
    measured = [] if any(choice.estimated_m for choice in training.choices) else training.views
    written = decomposed.write(run, measured, training.views_of) | write_robot(
        run, training.robot, links
    )
    if not config.models.any_named and not has_leaf("perception"):
        return written
    # Not what was fitted: Gaussians gather where colours change, and every fit puts them elsewhere.
    searched = None
    if not config.models.segmenter:
        searched = fuse(training.points, SEARCHED_SPLATS, training.views)
    named: dict[str, Any] = load_leaf("perception", "name_things")(
        run.scene_dir,
        decomposed,
        training.views,
        config.fit.threads,
        output,
        fused=searched,
        models=config.models,
        choices=training.choices,
        task=scanned_tasks(sources).task,
    )
    return written | named


def _key(
    sources: Sources,
    config: RebuildConfig,
    calibration: Calibration | None,
    models: Mapping[str, str],
) -> str:
    settings = asdict(config)
    settings.pop("force")
    settings["fit"].pop("threads")
    settings["fit"]["budget_s"] = config.fit.budget_s or DEFAULT_BUDGET_S  # keys of older scenes
    settings["models"].pop("device")
    hashes = {str(e.path.name): e.sha256() for e in sources.episodes}
    task = scanned_tasks(sources).task  # shapes and colours decide the objects
    return provenance.hash_settings(
        {
            "method": METHOD_VERSION,
            "episodes": hashes,
            "settings": settings,
            "models": dict(models),
            "task": None if task is None else asdict(task),
            "calibration": _mounts(config, calibration),
        }
    )


def _mounts(config: RebuildConfig, calibration: Calibration | None) -> dict[str, Any] | None:
    """Where calibrated cameras sit, if that counts; what else was calibrated changes no scene."""
    if calibration is None or not calibration.cameras or config.frames.poses != "auto":
        return None
    return {key: place.to_record() for key, place in sorted(calibration.cameras.items())}


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
    links = record.get("robot", {}).get("links", {})
    needed += [run.scene_dir / item["file"] for item in links.values()]
    if "semantics" in record:
        about = record["semantics"]
        named = [about, about.get("vectors") or {}]
        needed += [run.scene_dir / item["file"] for item in named if "file" in item]
    static = (record.get("sdf") or {}).get("file")
    needed += [run.scene_dir / static] if static else []
    whole = all(path.is_file() for path in needed)
    return record if whole and background_hash(run) == record["scene_hash"] else None


def _is_ours(path: Path) -> bool:
    try:
        derived = Episode.open(path).derived
    except BridgeError:
        return False
    return derived is not None and derived.engine == ENGINE
