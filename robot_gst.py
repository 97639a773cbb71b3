"""The command ``robot-gst``, which only lists the commands of the packages.

Everything is lazy: a command's module is imported when the command runs.
"""

import io
import os
import shlex
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

from cyclopts import App, Parameter
from cyclopts.config import Toml
from rich.console import Console

from bridge.ending import end_with_starter
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.gone import refuse_gone

HELP = (
    "Record a robot cell over zenoh, rebuild it as a Gaussian-splat twin, replay every plan and "
    "execution in it, and say how far the twin can be trusted."
)
RESUMED = ("demo", "trials", "rebuild", "replay", "evaluate")
"""Commands that keep what they did when they are interrupted, and go on from there."""

EPISODES, PUBLISH = "bridge.cli.episodes", "bridge.cli.publish"
TASKS = "bridge.cli.tasks"
RECORDING, EXCHANGE = "bridge.cli.recording", "bridge.cli.exchange"

LISTS = Parameter(consume_multiple=True, negative_iterable="")
"""``--policies nominal loose`` and ``--policies nominal --policies loose`` say the same."""

Command = tuple[str, str, str, str]
"""Name, function, what it does, and an example of what follows its name."""
COMMANDS: tuple[Command, ...] = (
    (
        "demo",
        "dashboards.cli:demo",
        "Run the whole loop on the stand-in cell, in minutes.",
        "runs/demo",
    ),
    (
        "trials",
        "dashboards.cli:trials",
        "Try policies without and with replanning on the same starts.",
        "runs/study --trials 20",
    ),
    (
        "design",
        "evaluator.cli:design",
        "Size a study before its first trial, and lock its protocol.",
        "runs/study --rate 0.5 --gain 0.3 --width 0.4",
    ),
    ("record", f"{RECORDING}:record", "Record episodes live over zenoh.", "runs/monday"),
    (
        "ctl",
        f"{RECORDING}:ctl",
        "Start, stop, mark or label from another terminal.",
        "start --id trial_1",
    ),
    ("info", f"{EPISODES}:info", "Show what an episode holds.", "runs/demo/episodes/scan.mcap"),
    ("check", f"{EPISODES}:check", "Verify an episode and list dropped messages.", "runs/demo"),
    (
        "recover",
        f"{EPISODES}:recover",
        "Repair what a killed recorder left; report what is lost.",
        "runs/demo",
    ),
    ("ls", f"{EPISODES}:ls", "List the episodes of a run.", "runs/demo --outcome failure"),
    (
        "label",
        f"{EPISODES}:label",
        "Set the outcome of a recorded episode.",
        "runs/demo trial_1 --result failure",
    ),
    (
        "rebuild",
        "twin.cli:rebuild",
        "Fit a Gaussian-splat scene; render held-out views.",
        "runs/monday --budget 60s",
    ),
    ("render", "twin.cli:render", "Render the rebuilt scene to PNG.", "runs/monday"),
    (
        "calibrate",
        "twin.cli:calibrate",
        "Calibrate cameras or physics from recorded episodes.",
        "runs/monday --cameras",
    ),
    (
        "replay",
        "twin.cli:replay",
        "Replay every planned and executed trajectory in the twin.",
        "runs/monday --workers 2",
    ),
    (
        "gate",
        "twin.cli:gate",
        "Judge plans over zenoh before the robot moves.",
        "runs/monday",
    ),
    (
        "plan",
        "twin.plan.cli:plan",
        "Plan from words, or for a cell that asks over zenoh.",
        "runs/monday --task 'put the cube into the box' --dry",
    ),
    (
        "evaluate",
        "evaluator.cli:evaluate",
        "Compute success rates and agreement; write a report.",
        "runs/monday",
    ),
    (
        "dashboard",
        "dashboards.cli:dashboard",
        "Serve review pages on the loopback address.",
        "runs/monday",
    ),
    (
        "view",
        "dashboards.cli:view",
        "Open an episode and its replays in Rerun's 3D viewer.",
        "runs/monday",
    ),
    (
        "share",
        "dashboards.cli:share",
        "Write trials with their clips into one file to send.",
        "runs/monday --trials trial_0003",
    ),
    (
        "doctor",
        f"{EPISODES}:doctor",
        "Show what is installed, what is missing and how to get it.",
        "--json",
    ),
)

GROUPS: dict[str, tuple[str, tuple[Command, ...]]] = {
    "publish": (
        "Publish sensor and robot data over zenoh.",
        (
            (
                "folder",
                f"{PUBLISH}:publish_folder",
                "Play an RGB-D folder as a live camera.",
                "DIR --episode scan",
            ),
            (
                "episode",
                f"{PUBLISH}:publish_episode",
                "Play an episode back with its own timing.",
                "FILE --rate 2 --topics 'lab/**'",
            ),
            (
                "realsense",
                f"{PUBLISH}:publish_realsense",
                "RealSense cameras: colour, depth, calibration.",
                "--cell lab --camera side=123622270224",
            ),
            (
                "ur",
                f"{PUBLISH}:publish_ur",
                "A UR arm: joints, tool, gripper, modes.",
                "192.168.1.10 --cell lab",
            ),
            (
                "standin",
                f"{PUBLISH}:publish_standin",
                "The stand-in cell: a simulated laboratory.",
                "--trials 3 --seed 1",
            ),
        ),
    ),
    "task": (
        "Write and check task files.",
        (
            (
                "check",
                f"{TASKS}:check",
                "Say what is wrong with task files, or what they ask for.",
                "my_task.toml",
            ),
            ("new", f"{TASKS}:new", "Write a task file to start from.", "cube_onto_block"),
        ),
    ),
    "robot": (
        "Robot files: arms, grippers and tools.",
        (
            (
                "check",
                "twin.cli:robot_check",
                "Joints, limits, frames, gripper; what is refused.",
                "mine.toml",
            ),
        ),
    ),
    "import": (
        "Import recordings of other programs into a run.",
        (
            (
                "rgbd",
                f"{EXCHANGE}:import_rgbd",
                "An RGB-D folder: scene.json, TUM, 7-Scenes.",
                "DIR runs/x",
            ),
            (
                "images",
                f"{EXCHANGE}:import_images",
                "Posed images without depth: COLMAP, transforms.json.",
                "DIR runs/x",
            ),
            (
                "rosbag2",
                f"{EXCHANGE}:import_rosbag2",
                "A rosbag2 recording, byte for byte.",
                "BAG runs/x",
            ),
            (
                "lerobot",
                f"{EXCHANGE}:import_lerobot",
                "A LeRobotDataset v3.0, one episode file each.",
                "DIR runs/x --episodes 0-9",
            ),
            (
                "trials",
                f"{EXCHANGE}:import_trials",
                "A trials CSV, for evaluate.",
                "trials.csv runs/x",
            ),
        ),
    ),
    "export": (
        "Export episodes to formats of other programs.",
        (
            (
                "lerobot",
                f"{EXCHANGE}:export_lerobot",
                "Trials as a LeRobotDataset v3.0.",
                "runs/x DIR",
            ),
            (
                "tum",
                f"{EXCHANGE}:export_tum",
                "Cameras as folders of the TUM RGB-D layout.",
                "EPISODE DIR",
            ),
            (
                "rosbag2",
                f"{EXCHANGE}:export_rosbag2",
                "An episode as a rosbag2 folder.",
                "EPISODE DIR",
            ),
            (
                "csv",
                f"{EXCHANGE}:export_csv",
                "Joints, poses, events ... as tidy CSV files.",
                "runs/x DIR",
            ),
        ),
    ),
}


def build_app() -> App:
    """Make the command tree; nothing heavy is imported."""
    app = App(
        name="robot-gst",
        help=HELP,
        version=_version,
        result_action="return_value",
        suppress_keyboard_interrupt=False,
        console=Console(),
        error_console=Console(stderr=True),
        default_parameter=LISTS,
    )
    for name, target, text, example in COMMANDS:
        app.command(target, name=name, help=_help(text, f"{name} {example}"))
    for name, (text, members) in GROUPS.items():
        group = App(name=name, help=text)
        for member, target, member_text, example in members:
            help_text = _help(member_text, f"{name} {member} {example}")
            group.command(target, name=member, help=help_text)
        app.command(group)
    return app


def _help(text: str, example: str) -> str:
    return f"{text}\n\nExample: robot-gst {example}"


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code (0, 1, 2, 3 or 130; see docs/cli.md)."""
    app = build_app()
    try:
        tokens, config = _take_config(list(arguments))
        if config is not None:
            app.config = Toml(config, must_exist=True)
        refuse_gone(tokens)
        code = app(tokens)
    except GstError as error:
        sys.stderr.write(f"robot-gst: {error}\n")
        return error.exit_code
    except BrokenPipeError:  # whoever read our output, for example head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        cause = error.strerror or str(error)
        sys.stderr.write(
            f"robot-gst: cannot read or write{where}: {cause}. "
            "Check the path, its permissions and the free space, then run the command again.\n"
        )
        return 1
    except KeyboardInterrupt:
        again = shlex.join(["robot-gst", *arguments])
        more = f"; continue with: {again}" if arguments and arguments[0] in RESUMED else ""
        sys.stderr.write(f"robot-gst: interrupted{more}\n")
        return 130
    except SystemExit as end:  # cyclopts leaves this way on wrong use
        return end.code if isinstance(end.code, int) else 2
    return code if isinstance(code, int) else 0


def main() -> None:
    """Entry point of the ``robot-gst`` command."""
    _prepare_streams()
    end_with_starter()
    sys.exit(run(sys.argv[1:]))


def _prepare_streams() -> None:
    """Open closed standard streams, and replace characters that a stream cannot encode.

    Where one was closed, the next file to be opened would get its number, and whatever a library
    prints would end up in that file.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


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
                continue
            if not path.is_file():
                raise PathNotFoundError(path=path, what="settings file", hint="Check the path.")
            _check_tables(path)
            return tokens[:index] + rest, path
    return tokens, None


def _check_tables(path: Path) -> None:
    """Refuse a table that is not named after a command: nobody would read it.

    Raises:
        UsageError: Naming it, and the names there are.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except ValueError:  # cyclopts reports it better
        return
    known: dict[str, set[str]] = {name: set() for name, *_ in COMMANDS}
    known |= {group: {name for name, *_ in members} for group, (_, members) in GROUPS.items()}
    for name, table in content.items():
        refuse_gone([name])
        wrong = [name] if name not in known else []
        if name in GROUPS and isinstance(table, dict):
            wrong = [f"{name}.{member}" for member in table if member not in known[name]]
        if wrong:
            there = ", ".join(known if name not in known else sorted(known[name]))
            message = f"{path} has [{wrong[0]}], but no command has that name. There are: {there}."
            raise UsageError(message)


def _version() -> str:
    from bridge.episode.provenance import software

    about = software()
    return f"{about['version']} {about['git_commit'][:12]}".strip()


if __name__ == "__main__":
    main()
