"""The commands of docs/recording.md: each one parses, and the first episode is made with them."""

import json
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from loopback import free_endpoint
from rtde_server import RtdeServer

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
WAIT_S = 30.0


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
    gripper = bound.arguments["config"].make_gripper()
    assert gripper is not None
    assert gripper.open_m > gripper.closed_m


def test_there_is_enough_to_test() -> None:
    assert len(COMMANDS) > 15
    assert len(OPTIONS) == 4


def test_the_mounts_of_the_guide_can_be_read(tmp_path: Path) -> None:
    (example,) = [block for kind, block in BLOCKS if kind == "json"]
    (tmp_path / "mounts.json").write_text(example)
    assert set(read_mounts(tmp_path / "mounts.json", ["side", "wrist"])) == {"side", "wrist"}


Run = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Run]:
    children: list[subprocess.Popen[str]] = []

    def make(*arguments: str) -> "subprocess.Popen[str]":
        child = subprocess.Popen(
            [sys.executable, str(ROOT / "robot_gst.py"), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        children.append(child)
        return child

    yield make
    for child in children:
        if child.poll() is None:
            child.kill()
        child.communicate()


def finish(child: "subprocess.Popen[str]") -> tuple[int, str]:
    out, err = child.communicate(timeout=WAIT_S)
    return child.returncode, out + err


@pytest.mark.slow
def test_from_an_arm_to_a_checked_episode_and_through_a_crash(start: Run, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    run = str(tmp_path / "lab")
    here = ("--connect", endpoint)

    def ask(*arguments: str) -> tuple[int, str]:
        return finish(start(*arguments))

    def wait_for_status(words: str) -> None:
        end_s = time.monotonic() + WAIT_S
        while words not in (said := ask("ctl", "status", "--json", *here)[1]):
            assert time.monotonic() < end_s, said

    with RtdeServer(lambda number: {"robot_mode": 7, "safety_mode": 1}) as server:
        recorder = start("record", run, "--listen", endpoint, "--min-free-mb", "1")
        wait_for_status('"ok": true')
        arm = start(
            "publish", "ur", "127.0.0.1", "--port", str(server.port), "--cell", "lab", *here
        )
        wait_for_status("/lab/joint_states")
        assert ask("ctl", "start", "--id", "trial_0001", "--cell", "lab", *here)[0] == 0
        sent = len(server.sent)
        while len(server.sent) < sent + 250:  # half a second of samples
            time.sleep(0.02)
        assert ask("ctl", "mark", "grasped", *here)[0] == 0
        assert ask("ctl", "stop", "--result", "success", *here)[0] == 0
        code, said = ask("check", run)
        assert code == 0, said
        assert ask("label", run, "trial_0001", "--result", "failure")[0] == 0
        assert "failure" in ask("ls", run)[1]

        assert ask("ctl", "start", "--id", "trial_0002", *here)[0] == 0
        sent = len(server.sent)
        while len(server.sent) < sent + 500:
            time.sleep(0.02)
        recorder.kill()
        recorder.communicate()
        code, said = ask("recover", run)
        assert code == 0, said
        code, said = ask("check", f"{run}/episodes/trial_0002.mcap", "--json")
        assert code == 3, said
        assert json.loads(said)
        arm.send_signal(signal.SIGINT)
        code, said = finish(arm)
        assert code == 0, said
        assert "0 lost before they got here" in said
