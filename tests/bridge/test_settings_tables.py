"""Tables of a settings file are named like the commands; others are refused, not passed over."""

from pathlib import Path

import pytest

import robot_gst


def settings(folder: Path, text: str) -> str:
    """Write a settings file and return its path."""
    path = folder / "settings.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("replays", "has [replays], but no command has that name. There are: doctor, record"),
        (
            "publish.stand-in",
            "has [publish.stand-in], but no command has that name. There are:",
        ),
    ],
)
def test_a_table_that_is_named_like_no_command_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: str, said: str
) -> None:
    path = settings(tmp_path, f"[{table}]\nseed = 2\n")
    assert robot_gst.run(["ls", str(tmp_path), "--config", path]) == 2
    assert said in capsys.readouterr().err


def test_tables_of_other_commands_may_stand_beside(tmp_path: Path) -> None:
    path = settings(tmp_path, "[replay]\nworkers = 2\n\n[publish.standin]\nseed = 2\n")
    assert robot_gst.run(["doctor", "--help", "--config", path]) == 0
