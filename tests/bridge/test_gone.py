"""Commands and flags that went: answered once, with what to use instead."""

from pathlib import Path

import pytest

import robot_gst
from bridge.gone import GONE

THERE = {command.name for command in robot_gst.commands()}


@pytest.mark.parametrize("name", sorted(GONE))
def test_what_went_is_answered_with_what_to_use(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command, *flag = name.split(" --")
    tokens = [*command.split(), "runs/x", *(f"--{each}=1" for each in flag)]
    assert robot_gst.run(tokens) == 2
    assert f"robot-gst: {name} is gone. {GONE[name]}" in capsys.readouterr().err
    assert GONE[name].endswith(".")


def test_the_table_names_no_command_that_is_there() -> None:
    commands = {name for name in GONE if " --" not in name}
    assert not commands & THERE
    assert {name.split(" --")[0] for name in GONE.keys() - commands} <= THERE


def test_a_settings_table_of_a_command_that_went_is_answered_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tmp_path / "old.toml"
    settings.write_text("[sync]\nverify = true\n")
    assert robot_gst.run(["doctor", "--config", str(settings)]) == 2
    assert "sync is gone" in capsys.readouterr().err
