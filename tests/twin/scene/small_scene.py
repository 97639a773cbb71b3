"""The textured room, rebuilt in a moment: to see what becomes of a scene, not how good it is."""

from pathlib import Path

import textured_room

from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output
from twin.scene.rebuild.run import rebuild
from twin.scene.settings import FitConfig, InitialiseConfig, RebuildConfig

QUIET = Output(quiet=True)
CONFIG = RebuildConfig(
    fit=FitConfig(iterations=6, threads=1),
    initialise=InitialiseConfig(max_splats=300, flying_fraction=0.1),
)


def rebuild_room(folder: Path) -> RunFolder:
    """Record a scan of the room into a new run in this folder, and rebuild it."""
    run = RunFolder.create(folder / "monday")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9)
    rebuild(run, CONFIG, QUIET)
    return run
