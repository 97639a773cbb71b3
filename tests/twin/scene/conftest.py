"""Lets these tests import the modules that lie beside them; a scene for each test."""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from bridge.episode.run_folder import RunFolder


@pytest.fixture(scope="module")
def few_voxels() -> Iterator[None]:
    """Let what a test rebuilds have coarse distances."""
    from small_scene import coarse_distances

    with coarse_distances():
        yield


@pytest.fixture(scope="session")
def rebuilt_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from small_scene import rebuild_room  # only tests of whole scenes load what it takes

    return rebuild_room(tmp_path_factory.mktemp("run")).path


@pytest.fixture
def room(rebuilt_once: Path, tmp_path: Path) -> RunFolder:
    """A copy of the small scene that a test may change."""
    return RunFolder(shutil.copytree(rebuilt_once, tmp_path / "monday"))
