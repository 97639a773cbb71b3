"""The textured room, rebuilt in a moment: to see what becomes of a scene, not how good it is."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import textured_room

from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output
from twin.scene.rebuild.run import rebuild
from twin.scene.settings import FitConfig, InitialiseConfig, RebuildConfig
from twin.scene.shape import static

QUIET = Output(quiet=True)
CONFIG = RebuildConfig(
    fit=FitConfig(iterations=6, threads=1),
    initialise=InitialiseConfig(max_splats=300, flying_fraction=0.1),
)


@contextmanager
def coarse_distances() -> Iterator[None]:
    """Let scenes have few voxels: their distances are tested beside what makes them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(static, "MAX_GRID", 30_000)
        yield


def rebuild_room(folder: Path) -> RunFolder:
    """Record a scan of the room into a new run in this folder, and rebuild it."""
    run = RunFolder.create(folder / "monday")
    textured_room.write_episode(run.episodes_dir / "scan.mcap", num_frames=9)
    with coarse_distances():
        rebuild(run, CONFIG, QUIET)
    return run
