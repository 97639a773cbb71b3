"""The front door: exit codes, one clear sentence, JSON on stdout, any standard streams, signals."""

import dataclasses
import importlib
import inspect
import json
import os
import re
import signal
import subprocess
import sys
import typing
from pathlib import Path

import pytest

import robot_gst
from bridge.episode.catalogue import find_episodes
from bridge.episode.metadata import EpisodeInfo, Outcome, to_strings
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError


@pytest.fixture
def run_path(tmp_path: Path) -> Path:
    run = RunFolder.create(tmp_path / "run")
    with EpisodeWriter(run.episodes_dir / "t1.mcap") as writer:
        writer.describe(EpisodeInfo(id="t1", kind="trial", stand_in=True))
    return run.path


def test_a_missing_episode_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    assert robot_gst.run(["info", "nowhere.mcap"]) == 2
    assert "episode not found: nowhere.mcap" in capsys.readouterr().err


def test_ctrl_c_while_the_program_loads_is_answered_in_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(robot_gst, "build_app", interrupt)
    assert robot_gst.run(["replay", "runs/x"]) == 130
    said = "robot-gst: interrupted; continue with: robot-gst replay runs/x\n"
    assert capsys.readouterr().err == said


def test_an_unknown_command_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    assert robot_gst.run(["fly"]) == 2
    assert "fly" in capsys.readouterr().err


def test_a_list_of_an_option_is_one_option_or_several() -> None:
    once = ["trials", "r", "--policies", "nominal", "loose", "--arms", "without", "--trials", "2"]
    each = ["trials", "r", "--arms", "without", "--policies", "nominal", "--policies", "loose"]
    _, together, _ = robot_gst.build_app().parse_args(once)
    _, repeated, _ = robot_gst.build_app().parse_args([*each, "--trials", "2"])
    assert together.arguments == repeated.arguments
    assert together.arguments["config"].policies == ("nominal", "loose")


def test_a_broken_episode_is_listed_with_its_error(run_path: Path) -> None:
    (run_path / "episodes" / "bad.mcap").write_bytes(b"nothing")
    entries = {entry.id: entry for entry in find_episodes(RunFolder.open(run_path))}
    assert "not a finished MCAP file" in entries["bad"].error
    assert entries["t1"].error == ""
    assert robot_gst.run(["check", str(run_path)]) == 1


READING = ("check", "evaluate", "info", "ls", "rebuild", "recover", "replay", "view")


@pytest.mark.parametrize("command", READING)
def test_a_folder_with_nothing_to_work_on_is_wrong_use_and_stays_as_it_is(
    command: str, tmp_path: Path
) -> None:
    (tmp_path / "holiday.txt").write_text("somebody else's")
    assert robot_gst.run([command, str(tmp_path), "--quiet"]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.txt"]


def test_reading_a_run_on_a_read_only_medium_writes_nothing(run_path: Path) -> None:
    folder = run_path / "episodes"
    for words in (["info", str(folder / "t1.mcap")], ["check", str(folder)]):
        assert robot_gst.run([*words, "--quiet"]) == 0
    assert [path.name for path in run_path.iterdir()] == ["episodes"]
    assert [path.name for path in folder.iterdir()] == ["t1.mcap"]


def test_the_list_fits_eighty_columns_and_gives_the_cause_of_what_is_unknown(
    run_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    why = "nothing executed, no verdict (not every object was found: cube hidden by the gripper)"
    name = "a_long_name_" * 7
    for id_, outcome in (("t2", Outcome(result="unknown", k=0, detail=why)), (name, None)):
        with EpisodeWriter(run_path / "episodes" / f"{id_}.mcap") as writer:
            info = EpisodeInfo(id=id_, kind="trial", condition="without_replanning")
            writer.describe(info)
            if outcome is not None:
                writer.add_metadata("outcome", to_strings(outcome))
    assert robot_gst.run(["ls", str(run_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[0] == "episode"
    assert name in lines  # a name too long for its column has a line of its own
    assert max(len(line) for line in lines if line != name) <= 80
    text = " ".join(line.strip() for line in lines)
    assert f"unknown: {why}" in text
    assert " unlabelled " in text
    robot_gst.run(["info", str(run_path / "episodes" / "t2.mcap")])
    assert f"outcome: unknown ({why})" in capsys.readouterr().out


def test_a_label_given_later_wins_and_leaves_the_episode_untouched(run_path: Path) -> None:
    run = RunFolder.open(run_path)
    before = (run.episodes_dir / "t1.mcap").read_bytes()
    assert robot_gst.run(["label", str(run_path), "t1", "--result", "failure"]) == 0
    assert find_episodes(run)[0].outcome == "failure"
    assert (run.episodes_dir / "t1.mcap").read_bytes() == before


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "x" * 200, "a b", "a\n"])
def test_an_episode_id_that_could_leave_the_run_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="not usable as a file name"):
        check_episode_id(name)


def test_a_settings_file_fills_in_options(
    run_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text("[ls]\njson = true\n")
    assert robot_gst.run(["ls", str(run_path), "--config", str(settings)]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"][0]["id"] == "t1"


@pytest.mark.parametrize("name", [command.name for command in robot_gst.commands()])
def test_every_command_has_help_with_an_example(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert robot_gst.run([*name.split(), "--help"]) == 0
    assert "Example" in capsys.readouterr().out


TARGETS = [command.target for command in robot_gst.commands()]


def help_sources(kind: type) -> list[str]:
    """The source of a settings class, and of those inside it: their docstrings are the help."""
    inner = [field.type for field in dataclasses.fields(kind)]
    inner = [getattr(each, "__origin__", each) for each in inner]
    found = [each for each in inner if dataclasses.is_dataclass(each)]
    return [inspect.getsource(kind), *(text for each in found for text in help_sources(each))]


@pytest.mark.parametrize("target", TARGETS)
def test_no_help_text_holds_what_the_terminal_would_swallow(target: str) -> None:
    module, name = target.split(":")
    function = getattr(importlib.import_module(module), name)
    texts = [inspect.getdoc(function) or ""]
    for kind in typing.get_type_hints(function).values():
        if dataclasses.is_dataclass(kind):
            texts.extend(help_sources(kind))
    assert [token for text in texts for token in re.findall(r"<[a-z_ ]+>", text)] == []


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
        [*PROGRAM, "ls", str(run.path), "--quiet"],  # on a busy machine it says that it works
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


ROOT = Path(__file__).resolve().parents[2]
INSIDE_THE_EVENT = """
import os, sys
from bridge.terminal import stop_signals
with stop_signals() as stopped:
    with stopped._cond:  # as the main thread holds it now and then while it waits
        os.kill(os.getpid(), int(sys.argv[1]))
        sum(range(1000))
    print(stopped.wait(20))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_interrupts_the_waiting_itself_is_heard(number: signal.Signals) -> None:
    """A handler that takes the event's lock would wait for the code it has interrupted."""
    done = subprocess.run(
        [sys.executable, "-c", INSIDE_THE_EVENT, str(int(number))],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=ROOT,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", "")
