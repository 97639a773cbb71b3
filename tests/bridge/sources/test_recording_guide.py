"""The commands of docs/recording.md: each one parses, and the first episode is made with them."""

import re
import shlex
from pathlib import Path

import pytest

import robot_gst
from bridge.sources.realsense.messages import read_mounts

ROOT = Path(__file__).resolve().parents[3]
GUIDE = (ROOT / "docs" / "recording.md").read_text()
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", GUIDE, re.DOTALL)
COMMANDS = sorted(
    {
        line
        for kind, block in BLOCKS
        if not kind
        for line in block.splitlines()
        if line.startswith("robot-gst ")
    }
)
OPTIONS = sorted(set(re.findall(r"\| `(--gripper [^`]+)` \|", GUIDE)))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_of_the_guide_is_understood(command: str) -> None:
    tokens = shlex.split(command)[1:]
    app = robot_gst.build_app()
    found, bound, *_ = app.parse_args(tokens, print_error=False, exit_on_error=False)
    assert callable(found)
    assert bound.arguments is not None


@pytest.mark.parametrize("options", OPTIONS)
def test_every_gripper_of_the_guide_is_understood(options: str) -> None:
    app = robot_gst.build_app()
    tokens = ["publish", "ur", "192.168.1.10", *shlex.split(options)]
    _, bound, *_ = app.parse_args(tokens, print_error=False, exit_on_error=False)
    config = bound.arguments["config"]
    assert config.make_gripper() is not None
    assert config.gripper_open_m > config.gripper_closed_m


def test_there_is_enough_to_test() -> None:
    assert len(COMMANDS) > 15
    assert len(OPTIONS) == 4


def test_the_mounts_of_the_guide_can_be_read(tmp_path: Path) -> None:
    (example,) = [block for kind, block in BLOCKS if kind == "json"]
    (tmp_path / "mounts.json").write_text(example)
    assert set(read_mounts(tmp_path / "mounts.json", ["side", "wrist"])) == {"side", "wrist"}
