"""Peak memory of a rebuild of 100 VGA frames, in a process of its own.

Fusing and fitting a made-up table with 200,000 Gaussians, and all of ``rebuild`` on the real
kitchen with the default budget of Gaussians, where it is at hand.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from measure import ROOT, Target, report_targets

NUM_FRAMES, NUM_SPLATS = 100, 200_000
LIMIT_GB = 1.2
IMAGES = 40


def main() -> None:
    """Start the work and read what it says."""
    command = [sys.executable, __file__, "work"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    peak_gb, count, seconds = (float(word) for word in done.stdout.split())
    target = Target(
        what=f"peak resident memory, {NUM_FRAMES} VGA frames, {count:.0f} Gaussians",
        measured=peak_gb,
        limit=LIMIT_GB,
        unit="GB",
        reference=f"fused in {seconds:.1f} s of CPU time",
    )
    note = "frames read one by one as rebuild does, fused, solved and fitted for a few images"
    report_targets("splat_memory", [target, *whole_rebuild()], note=note)


def whole_rebuild() -> list[Target]:
    """One row for the kitchen; none where it is not at hand."""
    from splat.kitchen import kitchen_folder

    source = kitchen_folder()
    if source is None:
        print("splat_memory: no kitchen here (GST_SHARED_DATA); its row is left out")
        return []
    command = [sys.executable, __file__, "rebuild", str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    peak_mb, frames = (float(word) for word in done.stdout.split()[-2:])
    return [
        Target(
            what=f"peak resident memory of rebuild, kitchen, {frames:.0f} VGA frames",
            measured=peak_mb / 1e3,
            limit=LIMIT_GB,
            unit="GB",
            reference=f"{IMAGES} training images",
        )
    ]


def rebuild_kitchen(source: Path) -> None:
    """Rebuild and print the peak [MB] and the training frames."""
    import resource

    from splat.scans import QUIET, shelf_scan

    from twin.scene.rebuild.run import rebuild
    from twin.scene.settings import FitConfig, FrameConfig, RebuildConfig

    config = RebuildConfig(
        frames=FrameConfig(max_train_frames=NUM_FRAMES, max_holdout_frames=4),
        fit=FitConfig(iterations=IMAGES, threads=1),
    )
    with tempfile.TemporaryDirectory() as folder:
        record = rebuild(shelf_scan(source, Path(folder) / "kitchen"), config, QUIET)
    frames = sum(camera["train_frames"] for camera in record["cameras"])
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, frames)


def work() -> None:
    """Rebuild a made-up table and print the peak [GB], the Gaussians and the seconds of fusing."""
    import resource
    import time

    from splat.quality import MAX_DEPTH_M, MAX_POINTS

    from twin.scene.fit.initialise import fuse
    from twin.scene.fit.optimise import fit
    from twin.scene.frames.rgbd import DepthLimits, FrameSurface, training_view
    from twin.scene.settings import FitConfig

    limits = DepthLimits(max_depth_m=MAX_DEPTH_M, flying_fraction=0.03)
    stride = max(1, round((NUM_FRAMES * 640 * 480 / MAX_POINTS) ** 0.5))
    points, views = [], []
    for index in range(NUM_FRAMES):
        surface = FrameSurface(_frame(index), limits)
        points.append(surface.points(stride))
        views.append(training_view(surface))
    start = time.process_time()
    cloud = fuse(points, NUM_SPLATS, views)
    seconds = time.process_time() - start
    points.clear()
    steps = FitConfig(iterations=11)
    fit(cloud, views, steps, lambda *_: None, max_splats=NUM_SPLATS)
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    print(peak_gb, len(cloud), seconds)


def _frame(index: int) -> object:
    """A patterned plane seen from above."""
    import numpy as np
    from splat.clean_tabletop import camera, look_at_table

    from bridge.episode.streams import RgbdFrame

    T, seen = look_at_table(index / NUM_FRAMES), camera()
    rays = seen.rays() @ T[:3, :3].T
    depth_m = -T[2, 3] / rays[..., 2]
    p = T[:3, 3] + rays * depth_m[..., None]
    waves = np.stack([np.sin(31 * p[..., 0]), np.cos(29 * p[..., 1]), np.sin(17 * p.sum(-1))], -1)
    return RgbdFrame(
        camera_id="plane",
        stamp_ns=index,
        image_u8=np.rint(127 + 100 * waves).astype(np.uint8),
        depth_m=depth_m.astype(np.float32),
        color_camera=seen,
        depth_camera=seen,
        T_base_color=T,
        T_base_depth=T,
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["rebuild"]:
        rebuild_kitchen(Path(sys.argv[2]))
    else:
        work() if sys.argv[1:] == ["work"] else main()
