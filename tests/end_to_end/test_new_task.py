"""The tutorial of a new task, command by command as it is printed, with smaller pictures."""

import json
import re
import shlex
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

import robot_gst
from bridge.episode import streams
from bridge.episode.reader import Episode

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "new_task.md"
SMALL = {
    "publish": ["--image-scale", "0.5", "--rate-hz", "2"],
    "rebuild": ["--max-splats", "15000", "--max-train-frames", "20", "--max-holdout-frames", "3"],
    "replay": ["--json"],
    "info": ["--json"],
}
ITERATIONS = "300"
"""What the tutorial asks of the rebuild; sixty are enough to go on with."""
COMMANDS = ["task", "task", "record", "publish", "ls", "info", "rebuild", "replay", "evaluate"]
RECORDED, READ = COMMANDS.index("record"), COMMANDS.index("ls")

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("unchecked")]
Recorder = Callable[[Path, str], AbstractContextManager[Any]]


def printed_commands() -> list[list[str]]:
    blocks = re.findall(r"^```\w*\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines()]
    words = [shlex.split(line) for line in lines]
    commands = [w[1:] for w in words if w[:1] == ["robot-gst"]]
    fewer = [["60" if word == ITERATIONS else word for word in w] for w in commands]
    assert sum(w != f for w, f in zip(commands, fewer, strict=True)) == 1
    return [[*w, *SMALL.get(w[0], [])] for w in fewer]


def test_a_new_task_goes_from_its_file_to_the_report(
    recorder: Recorder,
    endpoint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    commands = printed_commands()
    assert [words[0] for words in commands] == COMMANDS

    def run(words: list[str]) -> str:
        capsys.readouterr()
        assert robot_gst.run(words) == 0, (words, capsys.readouterr().err[-3000:])
        return capsys.readouterr().out

    said = [run(words) for words in commands[:RECORDED]]
    assert "cube rests on block" in said[1]
    folder = tmp_path / "runs" / "block"
    with recorder(folder, endpoint):
        for words in commands[RECORDED + 1 : READ]:
            assert "1 success" in run([*words, "--connect", endpoint])
    mine = (tmp_path / "cube_onto_block.toml").read_bytes()
    (tmp_path / "cube_onto_block.toml").unlink()
    for path in (folder / "episodes").glob("*.mcap"):
        assert streams.task_file(Episode.open(path)).data == mine
    said = [run(words) for words in commands[READ:]]
    assert json.loads(said[1])["info"]["task"] == "cube_onto_block"
    record = json.loads((folder / "scene" / "scene.json").read_text())
    assert set(record["objects"]) == {"cube", "block"}
    rows = [row for row in json.loads(said[3])["rows"] if row["mode"] == "dynamic"]
    assert {row["trajectory"] for row in rows} == {"planned", "executed"}
    assert all(row["error"] is None and row["accepted"] is not None for row in rows)
    assert "recorded (stand-in): 1/1" in said[4]
