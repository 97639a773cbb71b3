"""Peak memory of ``rebuild`` on the real kitchen (GST_SHARED_DATA), in a process of its own."""

import subprocess
import sys
import tempfile
from pathlib import Path

from measure import ROOT, Target, report_targets

NUM_FRAMES, IMAGES, LIMIT_GB = 100, 40, 1.2


def main() -> None:
    """Start the work and read what it says."""
    from splat.kitchen import kitchen_folder

    source = kitchen_folder()
    if source is None:
        sys.exit("splat_memory: no kitchen here (GST_SHARED_DATA)")
    command = [sys.executable, __file__, str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    peak_mb, frames = (float(word) for word in done.stdout.split()[-2:])
    target = Target(
        what=f"peak resident memory of rebuild, kitchen, {frames:.0f} VGA frames",
        measured=peak_mb / 1e3,
        limit=LIMIT_GB,
        unit="GB",
        reference=f"{IMAGES} training images",
    )
    report_targets("splat_memory", [target], note="fused, solved and fitted for a few images")


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


if __name__ == "__main__":
    rebuild_kitchen(Path(sys.argv[1])) if sys.argv[1:] else main()
