"""Which episode to show, where its file goes, and Rerun's own window (on the loopback address)."""

import os
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from bridge.episode.reader import Episode
from bridge.episode.run_folder import PLAN_REPLAY, REFUSED_PLAN, RunFolder
from bridge.errors import GstError, PathNotFoundError, UsageError


def episode_of(target: Path) -> Path:
    """Return the episode to show: the file itself, a plan's replay, or the run's newest trial.

    Raises:
        UsageError: When there is no such file or folder, or the run has no episode.
    """
    if target.is_file():
        return target if target.suffix != ".json" else _replay_of_plan(target)
    if not target.is_dir():
        hint = "Give an episode file or a run folder; robot-gst ls RUN lists episodes."
        raise PathNotFoundError(path=target, what="episode or run", hint=hint)
    found = RunFolder.open(target).episodes()
    if not found:
        message = f"{target} holds no episodes. Record some: robot-gst record {target}."
        raise UsageError(message)
    return max(found, key=_rank)


def _replay_of_plan(path: Path) -> Path:
    name = path.name.removesuffix(REFUSED_PLAN).removesuffix(".json")
    found = path.with_name(f"{name}{PLAN_REPLAY}")
    if not found.is_file():
        message = (
            f"beside {path} there is no {found.name}, the twin's replay that is shown with a plan. "
            'Give a plan of a run\'s plans/, or make it again: robot-gst plan RUN --task "...".'
        )
        raise UsageError(message)
    return found


def _rank(path: Path) -> tuple[bool, int]:
    """Trials above scans, then later above earlier; what cannot be read comes last."""
    try:
        episode = Episode.open(path)
        return episode.info.kind == "trial", episode.start_ns
    except GstError:
        return False, -1


def default_out(episode: Path) -> Path:
    """Return where the Rerun file of an episode goes: its run's ``derived/``, or beside it."""
    folder = episode.parent
    if folder.name == "episodes":
        folder = RunFolder(folder.parent).derived_dir
    return folder / f"{episode.stem}.rrd"


def has_display(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> bool:
    """Say whether a window can be opened: always on macOS and Windows, with X or Wayland else."""
    is_named = bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))
    return is_named or platform in ("darwin", "win32")


def viewer_arguments(path: Path) -> list[str]:
    """Return Rerun's command line; its default would listen on every network address."""
    return ["rerun", "--bind", "127.0.0.1", "--port", "auto", str(path)]


def how_to_open(path: Path) -> str:
    """Return the command a person types to open the file on a machine with a screen."""
    return shlex.join(viewer_arguments(path))


def open_window(path: Path) -> int:
    """Start the viewer in a process of its own and return its number."""
    module = [sys.executable, "-m", *viewer_arguments(path)]
    process = subprocess.Popen(
        module,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    return process.pid
