"""Every command stands in the table of commands, and every documented command line parses."""

import re
import shlex
from pathlib import Path

import pytest
from cyclopts import App
from house_budget import options

import robot_gst

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "cli.md").read_text()
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def command_lines() -> list[str]:
    """Lines of the documents' code blocks that call ``robot-gst``."""
    texts = [path.read_text().replace("\\\n", " ") for path in DOCUMENTS]
    fences = re.compile(r"^```\w*\n(.*?)^```", re.DOTALL | re.MULTILINE)
    blocks = [block for text in texts for block in fences.findall(text)]
    lines = [line for block in blocks for line in block.splitlines()]
    return sorted(
        {line for line in lines if line.startswith("robot-gst ") and "COMMAND" not in line}
    )


def test_every_command_stands_in_the_table_of_commands() -> None:
    names = [command.name for command in robot_gst.commands()]
    missing = [name for name in names if not re.search(rf"`{name}[ `]", PAGE)]
    assert missing == []


@pytest.fixture(scope="module")
def app() -> App:
    return robot_gst.build_app()


@pytest.mark.parametrize("line", command_lines())
def test_a_documented_command_is_understood(line: str, app: App) -> None:
    for command in line.split(" && "):
        tokens = shlex.split(command.rstrip("& "), comments=True)[1:]
        if "--config" in tokens:  # taken by the front door before the command is parsed
            at = tokens.index("--config")
            del tokens[at : at + 2]
        found, *_ = app.parse_args(tokens, print_error=False, exit_on_error=False)
        assert callable(found)


def test_help_shows_at_most_fifteen_options_and_the_page_lists_the_others() -> None:
    _, _, listed = PAGE.partition("## Settings that help leaves out")
    for command, keys, shown in options():
        assert len(shown) <= 15, command
        rows = [line for line in listed.splitlines() if f"`{command}`" in line]
        missing = {key for key in keys if key not in shown and f"`{key}`" not in "".join(rows)}
        assert missing == set(), command


def test_pages_name_commands_that_are_there() -> None:
    there = {command.name for command in robot_gst.commands()}
    folder = ROOT / "dashboards" / "templates"
    for page in sorted(folder.glob("*.html")):
        for first, second in re.findall(r"robot-gst ([a-z]+)(?: ([a-z0-9]+))?", page.read_text()):
            assert first in there or f"{first} {second}" in there, (page.name, first, second)
