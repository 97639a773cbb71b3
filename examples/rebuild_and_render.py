"""Rebuild the scene of a run and render it from a pose of your choice.

Run: python examples/rebuild_and_render.py runs/demo view.png
"""

import sys
from pathlib import Path

from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output
from twin.scene.rebuild.run import rebuild
from twin.scene.render import render
from twin.scene.settings import FitConfig, RebuildConfig, RenderConfig


def main(folder: Path, image: Path, iterations: int = 200) -> None:
    """Fit a number of images: unlike a time budget, that is reproducible."""
    run = RunFolder.open(folder)
    output = Output(quiet=True)
    scene = rebuild(run, RebuildConfig(fit=FitConfig(iterations=iterations)), output)
    count, psnr_db = scene["background"]["num_splats"], scene["views"]["psnr_db"]
    print(f"{count} Gaussians; held-out views: {psnr_db:.1f} dB")

    view = RenderConfig(eye=(0.7, -0.7, 0.6), target=(0.0, 0.0, 0.0), out=image)
    print("wrote", *render(run, view)["files"])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
