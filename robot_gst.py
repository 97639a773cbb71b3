"""The front door: the command ``robot-gst``, which only lists the commands of the rooms.

Everything is lazy: a command's module is imported when the command runs.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from cyclopts import App
from cyclopts.config import Toml
from rich.console import Console

from bridge.errors import GstError, PathNotFoundError, UsageError

HELP = (
    "Record a robot cell over zenoh, rebuild it as a Gaussian-splat twin, re-live every plan and "
    "execution, and say how far the twin can be trusted."
)

COMMANDS: tuple[tuple[str, str, str], ...] = (
    ("demo", "dashboards.cli:demo", "The whole loop on a stand-in cell, in minutes."),
    ("record", "bridge.cli:record", "Record episodes live over zenoh."),
    ("ctl", "bridge.cli:ctl", "Start, stop, mark or label from anywhere."),
    ("publish", "", "Speak on the wire: an RGB-D folder or the stand-in cell."),
    ("import", "", "Bring other people's recordings into a run."),
    ("info", "bridge.cli:info", "What an episode holds."),
    ("check", "bridge.cli:check", "Whether an episode is whole, and what it declares lost."),
    ("ls", "bridge.cli:ls", "List the episodes of a run."),
    ("label", "bridge.cli:label", "Say after the fact how an episode ended."),
    ("rebuild", "twin.cli:rebuild", "Episodes to a Gaussian-splat scene with held-out renders."),
    ("render", "twin.cli:render", "Render the rebuilt scene to PNG."),
    ("replay", "twin.cli:replay", "Re-live every planned and executed trajectory."),
    ("gate", "twin.cli:gate", "Live verdicts over zenoh, before the robot moves."),
    ("evaluate", "evaluator.cli:evaluate", "Success rates, agreement, image quality; a report."),
    ("dashboard", "dashboards.cli:dashboard", "Review pages on the loopback address."),
    ("doctor", "bridge.cli:doctor", "What is installed, what is missing, how to get it."),
)

GROUPS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "publish": (
        ("folder", "bridge.cli:publish_folder", "Play an RGB-D folder as a live camera."),
        ("standin", "bridge.cli:publish_standin", "The stand-in cell: a simulated laboratory."),
    ),
    "import": (
        ("rgbd", "bridge.cli:import_rgbd", "An RGB-D folder with a scene.json."),
        ("kinova", "bridge.cli:import_kinova", "The Kinova reality-gap runs."),
    ),
}


def build_app() -> App:
    """Make the command tree; nothing heavy is imported."""
    app = App(
        name="robot-gst",
        help=HELP,
        version=_version,
        result_action="return_value",
        console=Console(),
        error_console=Console(stderr=True),
    )
    for name, target, help_text in COMMANDS:
        if name not in GROUPS:
            app.command(target, name=name, help=help_text)
            continue
        group = App(name=name, help=help_text)
        for sub_name, sub_target, sub_help in GROUPS[name]:
            group.command(sub_target, name=sub_name, help=sub_help)
        app.command(group)
    return app


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code (0, 1, 2, 3 or 130; see docs/cli.md)."""
    app = build_app()
    try:
        tokens, config = _take_config(list(arguments))
        if config is not None:
            app.config = Toml(config, must_exist=True)
        code = app(tokens)
    except GstError as error:
        sys.stderr.write(f"robot-gst: {error}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("robot-gst: interrupted\n")
        return 130
    except SystemExit as end:  # cyclopts leaves this way on wrong use
        return end.code if isinstance(end.code, int) else 2
    return code if isinstance(code, int) else 0


def main() -> None:
    """Entry point of the ``robot-gst`` command."""
    sys.exit(run(sys.argv[1:]))


def _take_config(tokens: list[str]) -> tuple[list[str], Path | None]:
    """Take ``--config FILE.toml`` out of the arguments; its tables are named like the commands."""
    for index, token in enumerate(tokens):
        if token == "--config" or token.startswith("--config="):
            _, _, value = token.partition("=")
            rest = tokens[index + 1 :]
            if not value:
                if not rest:
                    message = "--config needs a file: --config settings.toml."
                    raise UsageError(message)
                value, rest = rest[0], rest[1:]
            path = Path(value)
            if path.suffix != ".toml":  # zenoh's own configuration keeps its name and place
                return tokens, None
            if not path.is_file():
                raise PathNotFoundError(path=path, what="settings file", hint="Check the path.")
            return tokens[:index] + rest, path
    return tokens, None


def _version() -> str:
    from bridge.episode.provenance import software

    about = software()
    return f"{about['version']} {about['git_commit'][:12]}".strip()


if __name__ == "__main__":
    main()
