"""Commands run whatever their standard streams are: closed, or unable to show a sign."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter

PROGRAM = (sys.executable, "-m", "robot_gst")


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """A run with one scan, whose instruction not every terminal can show."""
    run = RunFolder.create(tmp_path / "run")
    with EpisodeWriter(run.episodes_dir / "scan.mcap") as writer:
        writer.describe(EpisodeInfo(id="scan", kind="scan", condition="früh → spät"))
    return run


@pytest.mark.slow
def test_a_sign_that_cannot_be_shown_is_replaced(run: RunFolder) -> None:
    said = subprocess.run(
        [*PROGRAM, "ls", str(run.path)],
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
        capture_output=True,
        check=False,
    )
    assert (said.returncode, said.stderr) == (0, b"")
    assert b"fr?h ? sp?t" in said.stdout


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_closed_stream_ends_no_command_and_lends_its_number_to_no_file(
    run: RunFolder, closed: str
) -> None:
    script = (
        "import os, sys, robot_gst; sys.argv = ['robot-gst', 'ls', sys.argv[1]]; "
        "robot_gst.run = lambda words, run=robot_gst.run: run(words) or 40 + min(3, "
        "os.open(os.devnull, os.O_RDONLY)); robot_gst.main()"
    )
    command = f'exec "$0" -c "$1" "$2" {closed}'
    shell = ["bash", "-c", command, sys.executable, script, str(run.path)]
    assert subprocess.run(shell, check=False, capture_output=True).returncode == 43


@pytest.mark.slow
def test_json_is_the_same_whatever_the_terminal_can_show(run: RunFolder) -> None:
    command = [*PROGRAM, "ls", str(run.path), "--json"]
    found = [
        subprocess.run(
            command, env=os.environ | {"PYTHONIOENCODING": name}, capture_output=True, check=True
        ).stdout
        for name in ("ascii", "utf-8")
    ]
    assert found[0] == found[1]
    assert json.loads(found[0])["episodes"][0]["condition"] == "früh → spät"
