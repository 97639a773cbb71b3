"""Commands of the package ``dashboards``; imports stay late so that --help is quick."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.terminal import Output
from dashboards.config import DashboardConfig, ShareConfig

OUTPUT = Output()
DASHBOARD = DashboardConfig()
SHARE = ShareConfig()


def dashboard(
    runs: list[Path],
    /,
    *,
    config: Annotated[DashboardConfig, Parameter(name="*")] = DASHBOARD,
    output: Output = OUTPUT,
) -> int:
    """Show the review pages of one or more runs until stopped.

    Example: robot-gst dashboard runs/monday runs/tuesday --port 0

    Args:
        runs: Run folders; the first one is shown first.
        config: Where to listen.
    """
    from bridge.errors import UsageError

    if not runs:
        raise UsageError("which run? For example: robot-gst dashboard runs/demo.")
    from dashboards.server import serve

    return serve(runs, config, output)


def share(run: Path, /, *, config: ShareConfig = SHARE, output: Output = OUTPUT) -> int:
    """Write chosen trials with clips, figures and tables into one file that opens anywhere.

    Example: robot-gst share runs/monday --trials trial_0003 trial_0007 --out two_trials.html

    Args:
        run: Run folder; robot-gst evaluate comes before.
        config: Which trials, and how large the file may be.
    """
    from bridge.episode.run_folder import RunFolder
    from dashboards.share_file import MB
    from dashboards.share_file import share as write

    path, made = write(RunFolder.open(run), config)
    for note in made.notes:
        output.say(f"Without a clip: {note}")
    record = {
        "path": str(path),
        "size_bytes": made.size_bytes,
        "trials": list(made.trials),
        "clips": made.clips,
    }
    text = f"{path}: {len(made.trials)} trials, {made.size_bytes / MB:.1f} MB ({made.clips})"
    output.result(record, text)
    return 0


def view(target: Path, /, *, out: Path | None = None, output: Output = OUTPUT) -> int:
    """Look at an episode or a plan in Rerun's own window, or say how to where none opens.

    Example: robot-gst view runs/monday

    Args:
        target: An episode file, a plan of a run's plans/, or a run folder for its newest trial.
        out: Only write this .rrd file; without it, one beside the run's derived episodes is opened.
    """
    from dashboards import rerun_viewer as viewer

    episode = viewer.episode_of(target)
    if target.is_dir():
        output.say(f"Showing {episode.stem}, the newest of {target}; name a file for another.")
    path = _export(episode, out or viewer.default_out(episode), output)
    if out is not None:
        return 0
    if viewer.has_display():
        output.say(f"Opened it in Rerun's window, process {viewer.open_window(path)}.")
    else:
        output.say(f"No display here. On a machine with one: {viewer.how_to_open(path)}")
    return 0


def _export(episode: Path, out: Path, output: Output) -> Path:
    from dashboards.rerun_view import export_rrd as export
    from dashboards.rerun_view import run_of

    done = export(episode, out, run_of(episode))
    for note in done.notes:
        output.say(f"Note: {note}")
    text = f"{done.path}: {done.size_bytes / 1e6:.1f} MB, {', '.join(done.sides)}"
    data = {
        "path": str(done.path),
        "episode": done.episode,
        "size_bytes": done.size_bytes,
        "sides": done.sides,
        "cameras": done.cameras,
        "not_shown": done.notes,
    }
    output.result(data, text)
    return done.path
