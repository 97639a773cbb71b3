"""Commands that exchange trials with LeRobot."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.exchange.lerobot.layout import LeRobotConfig
from bridge.terminal import Output

OUTPUT = Output()
LEROBOT = LeRobotConfig()


def export_lerobot(
    source: Path,
    out: Path,
    /,
    *,
    config: Annotated[LeRobotConfig, Parameter(name="*")] = LEROBOT,
    force: bool = False,
    output: Output = OUTPUT,
) -> int:
    """Write a run's trials as a LeRobotDataset v3.0: Parquet tables and H.264 video.

    README.md in OUT says what each column is.
    Example: robot-gst export lerobot runs/demo datasets/demo --fps 30

    Args:
        source: A run folder, or one episode file.
        out: The folder to make.
        config: Rate, actions, which episodes.
        force: Replace an earlier export.
    """
    from bridge.exchange.lerobot.export import export_lerobot as write_dataset
    from bridge.exchange.lerobot.export import select_episodes

    files, _ = select_episodes(source, config)
    with output.progress("export", 2 * len(files)) as advance:
        report = write_dataset(source, out, config=config, force=force, advance=advance)
    if report.left_out:
        output.say(f"left out, no trials: {', '.join(report.left_out)}")
    label = "with success labels" if report.labelled else "not every episode is labelled"
    text = (
        f"{out}: {report.episodes} episodes, {report.frames} rows at {report.fps} Hz, "
        f"actions: {report.action.replace('_', ' ')}, {label}; depth left out"
    )
    output.result({"out": str(out), **asdict(report)}, text)
    return 0


def import_lerobot(
    folder: Path,
    run: Path,
    /,
    *,
    cell: str = "lerobot",
    episodes: str | None = None,
    task: str | None = None,
    output: Output = OUTPUT,
) -> int:
    """Turn a LeRobotDataset v3.0 or v2 into episodes: joints, actions, images, one file each.

    Episodes already imported are passed over, so an interrupted import goes on where it stopped.
    Example: robot-gst import lerobot datasets/pusht runs/pusht --episodes 0-9

    Args:
        folder: The dataset: the folder with meta/info.json.
        run: Run folder; made where needed.
        cell: Name of the cell in topics.
        episodes: Which ones, for example 0-9,12; all without it.
        task: Name or file of the task they are trials of; without it, what the dataset names.
    """
    from bridge.episode.catalogue import task_of_run
    from bridge.episode.run_folder import RunFolder
    from bridge.episode.topics import refuse_bad_name
    from bridge.exchange.lerobot.importing import import_lerobot as read_dataset
    from bridge.exchange.lerobot.importing import parse_selection, read_episodes
    from bridge.exchange.lerobot.layout import read_info

    refuse_bad_name("cell", cell)
    wanted = parse_selection(episodes)
    total = len(read_episodes(read_info(folder), wanted))
    opened = RunFolder.create(run)
    name = task_of_run(opened, task) if task else ""
    with output.progress("import", total) as advance:
        report = read_dataset(folder, opened, cell=cell, wanted=wanted, advance=advance, task=name)
    for feature in report.left_out:
        output.say(f"left out: {feature}")
    text = f"{run}: {len(report.files)} episodes, {report.frames} rows"
    if report.already_there:
        text += f"; {report.already_there} were there already"
    output.result(
        {
            "files": [str(path) for path in report.files],
            "rows": report.frames,
            "already_there": report.already_there,
            "left_out": report.left_out,
        },
        text,
    )
    return 0
