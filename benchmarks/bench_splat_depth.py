"""Held-out depth of rebuilt scenes against an Open3D TSDF of the same training frames.

The real kitchen and the real shelf, where they are at hand, and the clean tabletop. Each scene is
fitted for a number of images, so that a busy machine changes nothing. A scene's name as an argument
measures that one only and stores nothing. Protocol in docs/reconstruction.md.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measure import ROOT, Target, print_targets, report_targets

from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output
from twin.scene.dataset.masks import find_moving, without_ego
from twin.scene.dataset.training_set import limits_of, read_training_set
from twin.scene.fit.initialise import fuse
from twin.scene.fit.optimise import FitResult, fit
from twin.scene.frames.rgbd import FrameSurface, PointSet, TrainingView, training_view
from twin.scene.frames.selection import choose_frames, find_sources, load
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser, psnr_db
from twin.scene.settings import FitConfig, FrameConfig, InitialiseConfig, RebuildConfig

IMAGES = 150
KITCHEN = FrameConfig(train_every=5, holdout_every=5, max_holdout_frames=30, max_train_frames=100)
CLEAN_SPLATS = 140_000
QUIET = Output(quiet=True)
CLEAN_MEDIAN_M = 0.5e-3


@dataclass(frozen=True, kw_only=True)
class Frames:
    """What a scene is made of, and what it is judged by."""

    points: list[PointSet]
    views: list[TrainingView]
    held_out: list[TrainingView]
    max_splats: int = InitialiseConfig().max_splats


def of_a_recording(source: Path, folder: Path, config: FrameConfig) -> Frames:
    """Training and held-out frames as ``rebuild`` reads them, what moves left out of both."""
    from splat.scans import shelf_scan

    run: RunFolder = shelf_scan(source, folder)
    whole = RebuildConfig(frames=config)
    choices = choose_frames(find_sources(run), config, QUIET).choices
    training = read_training_set(choices, whole, QUIET)
    held_out = []
    for index, choice in enumerate(training.choices):
        mask = training.ego_masks.get(index)
        for frame in load(choice, choice.holdout_ns):
            surface = FrameSurface(frame, limits_of(whole))
            view, points = training_view(surface), surface.points()
            if mask is not None:
                points, view = without_ego(points, view, mask)
            held_out.append(find_moving([points], training.reference_views).mask_in(view))
    return Frames(points=training.points, views=training.views, held_out=held_out)


def of_the_tabletop() -> Frames:
    """The synthetic scene, whose depth and poses are exact."""
    from splat.clean_tabletop import load as load_clean
    from splat.quality import MAX_POINTS

    scene = load_clean(ROOT / "build" / "benchmarks")
    limits = limits_of(RebuildConfig())
    surfaces = [FrameSurface(frame, limits) for frame in scene.train]
    pixels = sum(frame.depth_m.size for frame in scene.train)
    stride = max(1, round(float(np.sqrt(pixels / MAX_POINTS))))
    return Frames(
        points=[surface.points(stride) for surface in surfaces],
        views=[training_view(surface) for surface in surfaces],
        held_out=[training_view(FrameSurface(frame, limits)) for frame in scene.held_out],
        max_splats=CLEAN_SPLATS,
    )


def scenes(folder: Path) -> Iterator[tuple[str, Callable[[], Frames]]]:
    """Those that are at hand."""
    from splat.kitchen import kitchen_folder
    from splat.scans import shelf_folder

    for name, source, config in (
        ("kitchen", kitchen_folder(), KITCHEN),
        ("shelf", shelf_folder(), FrameConfig()),
    ):
        if source is None:
            print(f"splat_depth: no {name} here (GST_SHARED_DATA); its rows are left out")
        else:
            yield name, lambda s=source, n=name, c=config: of_a_recording(s, folder / n, c)
    yield "tabletop", of_the_tabletop


def mean_psnr_db(cloud: GaussianCloud, held_out: list[TrainingView]) -> float:
    """Raw, over the pixels that show nothing that moved; the mean of the images."""
    rasteriser, values = Rasteriser(RasterConfig(threads=1)), []
    for view in held_out:
        drawn = rasteriser.draw_planes(cloud, view.full.camera, view.T_base_color)[:3]
        wrong = np.square(np.clip(drawn, 0, 1) - view.full.image())
        values.append(psnr_db(float(wrong[:, view.full.static_mask].mean())))
    return float(np.mean(values))


def rows_of(name: str, frames: Frames) -> list[Target]:
    from splat.depth import Tsdf, depth_scores

    begun = time.process_time()
    config = InitialiseConfig(max_splats=frames.max_splats)
    first = fuse(frames.points, config.first_splats, frames.views)
    fused_s = time.process_time() - begun
    begun = time.process_time()
    fitted: FitResult = fit(
        first,
        frames.views,
        FitConfig(iterations=IMAGES, threads=1),
        lambda *_: None,
        max_splats=frames.max_splats,
    )
    fitted_s = time.process_time() - begun
    rasteriser = Rasteriser(RasterConfig(threads=1))
    ways = {"TSDF": Tsdf(frames.views).depth_m}
    for label, cloud in (("fused", first), ("fitted", fitted.cloud)):
        ways[label] = lambda camera, T, c=cloud: rasteriser.view(c, camera, T).depth_m
    scores = depth_scores(ways, frames.held_out)
    for label, score in scores.items():
        print(f"  {name}, {label:<6}  {score}")
    tsdf, ours = scores["TSDF"], scores["fitted"]
    share = "within_20mm" if name == "kitchen" else "within_5mm"
    psnr = mean_psnr_db(fitted.cloud, frames.held_out)
    about = f"{len(first)} then {len(fitted.cloud)} Gaussians, {psnr:.2f} dB"
    cost = f"{fused_s:.1f} and {fitted_s:.1f} CPU seconds"
    median_limit_m = CLEAN_MEDIAN_M if name == "tabletop" else tsdf.median_abs_m
    return [
        Target(what=f"{name}: depth, median error", measured=1e3 * ours.median_abs_m,
               limit=1e3 * median_limit_m, unit="mm", reference=f"TSDF {tsdf}; fitted {ours}"),
        Target(what=f"{name}: depth {share.replace('_', ' ')}", at_most=False, unit="%",
               measured=100 * getattr(ours, share), limit=100 * getattr(tsdf, share),
               reference=f"{about}; {cost}"),
    ]  # fmt: skip


def main() -> None:
    """All scenes, or the one that is named."""
    wanted = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        chosen = [item for item in scenes(Path(folder)) if not wanted or item[0] in wanted]
        rows = [row for name, frames in chosen for row in rows_of(name, frames())]
    note = (
        f"{IMAGES} training images; pixels that the recorded depth, the TSDF and the scene cover, "
        "all held-out views together"
    )
    if wanted:
        print_targets(rows)
    else:
        report_targets("splat_depth", rows, note=note)


if __name__ == "__main__":
    main()
