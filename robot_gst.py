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
from typing import TYPE_CHECKING, Any

from bridge import leaves
from bridge.ending import end_with_starter
from bridge.errors import GstError, PathNotFoundError, UsageError
from bridge.gone import refuse_gone
from bridge.heartbeat import BEAT

if TYPE_CHECKING:  # it takes a second on a busy machine, in which Ctrl-C may come already
    from cyclopts import App

HELP = (
    "Record a robot cell over zenoh, rebuild it as a Gaussian-splat twin, replay every plan and "
    "execution in it, and say how far the twin can be trusted."
)
RESUMED = ("demo", "trials", "rebuild", "replay", "evaluate")
"""Commands that keep what they did when they are interrupted, and go on from there."""

CORE: tuple[leaves.Command, ...] = (
    *leaves.commands_of(
        leaves.START,
        "bridge.cli.episodes",
        """
        doctor | Show what is installed, what is missing and how to get it. | --json
        """,
    ),
    *leaves.commands_of(
        leaves.RECORD,
        "bridge.cli.recording",
        """
        record | Record episodes live over zenoh. | runs/monday
        ctl | Start, stop, mark or label from another terminal. | start --id trial_1
        """,
    ),
    *leaves.commands_of(
        leaves.RECORD,
        "bridge.cli.tasks",
        """
        task check | Say what is wrong with task files, or what they ask for. | my_task.toml
        task new | Write a task file to start from. | cube_onto_block
        """,
    ),
    *leaves.commands_of(
        leaves.RECORD,
        "twin.cli",
        """
        robot check | Joints, limits, frames, gripper; what is refused. | mine.toml
        """,
    ),
    *leaves.commands_of(
        leaves.REVIEW,
        "bridge.cli.episodes",
        """
        info | Show what an episode holds. | runs/demo/episodes/scan.mcap
        check | Verify an episode and list dropped messages. | runs/demo
        recover | Repair what a killed recorder left; report what is lost. | runs/demo
        ls | List the episodes of a run. | runs/demo --outcome failure
        label | Set the outcome of a recorded episode. | runs/demo trial_1 --result failure
        """,
    ),
    *leaves.commands_of(
        leaves.REVIEW,
        "dashboards.cli",
        """
        dashboard | Serve review pages on the loopback address. | runs/monday
        view | Open an episode and its replays in Rerun's 3D viewer. | runs/monday
        share | Write trials with clips into one file to send. | runs/monday --trials trial_1
        """,
    ),
    *leaves.commands_of(
        leaves.REBUILD,
        "twin.cli",
        """
        rebuild | Fit a Gaussian-splat scene; render held-out views. | runs/monday --budget 60s
        render | Render the rebuilt scene to PNG. | runs/monday
        calibrate | Calibrate cameras or physics from recorded episodes. | runs/monday --cameras
        replay | Replay every planned and executed trajectory in the twin. | runs/monday --workers 2
        """,
    ),
    *leaves.commands_of(
        leaves.PLAN,
        "twin.cli",
        """
        gate | Judge plans over zenoh before the robot moves. | runs/monday
        """,
    ),
    *leaves.commands_of(
        leaves.EVALUATE,
        "evaluator.cli",
        """
        evaluate | Compute success rates and agreement; write a report. | runs/monday
        design | Size a study, and lock its protocol. | runs/study --rate 0.5 --gain 0.3
        """,
    ),
    *leaves.commands_of(
        leaves.EXCHANGE,
        "bridge.cli.exchange",
        """
        import rgbd | An RGB-D folder: scene.json, TUM, 7-Scenes. | DIR runs/x
        import rosbag2 | A rosbag2 recording, byte for byte. | BAG runs/x
        export tum | Cameras as folders of the TUM RGB-D layout. | EPISODE DIR
        export rosbag2 | An episode as a rosbag2 folder. | EPISODE DIR
        export csv | Joints, poses, events ... as tidy CSV files. | runs/x DIR
        """,
    ),
)

GROUPS = {
    "publish": ("Publish sensor and robot data over zenoh.", leaves.RECORD),
    "task": ("Write and check task files.", leaves.RECORD),
    "robot": ("Robot files: arms, grippers and tools.", leaves.RECORD),
    "import": ("Import recordings of other programs into a run.", leaves.EXCHANGE),
    "export": ("Export episodes to formats of other programs.", leaves.EXCHANGE),
}


def commands() -> tuple[leaves.Command, ...]:
    """Every command: the core's, and those that leaves bring."""
    return CORE + leaves.leaf_commands()


def build_app() -> "App":
    """Make the command tree; nothing heavy is imported."""
    from cyclopts import App, Group, Parameter
    from rich.console import Console

    app = App(
        name="robot-gst",
        help=HELP,
        version=_version,
        result_action="return_value",
        suppress_keyboard_interrupt=False,
        console=Console(),
        error_console=Console(stderr=True),
        # --policies nominal loose and --policies nominal --policies loose say the same.
        default_parameter=Parameter(consume_multiple=True, negative_iterable=""),
    )
    headings = {use: Group(use, sort_key=place) for place, use in enumerate(leaves.USES)}
    groups = {
        name: App(name=name, help=text, group=headings[use]) for name, (text, use) in GROUPS.items()
    }
    for command in commands():
        group, _, member = command.name.rpartition(" ")
        parent = groups[group] if group else app
        heading: dict[str, Any] = {} if group else {"group": headings[command.use]}
        parent.command(command.target, name=member, help=_help(command), **heading)
    for group_app in groups.values():
        app.command(group_app)
    return app


def _help(command: leaves.Command) -> str:
    return f"{command.text}\n\nExample: robot-gst {command.name} {command.example}"


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code (0, 1, 2, 3 or 130; see docs/cli.md)."""
    try:
        from cyclopts.config import Toml

        app = build_app()
        tokens, config = _take_config(list(arguments))
        if config is not None:
            app.config = Toml(config, must_exist=True)
        refuse_gone(tokens)
        leaves.refuse_missing_command(tokens)
        code = app(tokens)
    except GstError as error:
        sys.stderr.write(f"robot-gst: {error}\n")
        return error.exit_code
    except ModuleNotFoundError as error:
        from bridge.doctor import how_to_get  # only now

        sys.stderr.write(f"robot-gst: {how_to_get(error)}\n")
        return 1
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
    # Matrices here are small: threads that wait for the next one take a core, and bring nothing.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _prepare_streams()
    end_with_starter()
    with BEAT.watching(sys.argv[1:]):
        code = run(sys.argv[1:])
    sys.exit(code)


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
    known: dict[str, set[str]] = {}
    for command in commands():
        name, _, member = command.name.partition(" ")
        known.setdefault(name, set()).update({member} - {""})
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
