"""Every command stands in the table of commands."""

import re
from pathlib import Path

from robot_gst import COMMANDS, GROUPS

PAGE = (Path(__file__).parents[2] / "docs" / "cli.md").read_text()


def test_every_command_stands_in_the_table_of_commands() -> None:
    names = [name for name, *_ in COMMANDS]
    names += [f"{group} {name}" for group, (_, members) in GROUPS.items() for name, *_ in members]
    missing = [name for name in names if not re.search(rf"`{name}[ `]", PAGE)]
    assert missing == []
