"""What is said of a path that is no run folder."""

from pathlib import Path

import pytest

from bridge.episode.run_folder import RunFolder
from bridge.errors import PathNotFoundError, UsageError


def test_a_file_is_not_called_missing(tmp_path: Path) -> None:
    path = tmp_path / "trial_0001.mcap"
    path.write_bytes(b"")
    with pytest.raises(UsageError, match="is a file, not a run") as caught:
        RunFolder.open(path)
    assert not isinstance(caught.value, PathNotFoundError)


def test_a_folder_that_is_not_there_is_called_missing(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match="run folder not found"):
        RunFolder.open(tmp_path / "nowhere")
