"""Commands that exchange data with other people's programs."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from bridge.exchange.lerobot.config import LeRobotConfig
from bridge.terminal import Output

OUTPUT = Output()
LEROBOT = LeRobotConfig()


def export_tum(
    episode: Path,
    out: Path,
    /,
    *,
    camera: str | None = None,
    color: Literal["recorded", "png"] = "recorded",
    force: bool = False,
    output: Output = OUTPUT,
) -> int:
    """Write an episode's cameras as folders of the TUM RGB-D layout, with camera poses.

    One camera fills OUT itself, several get a folder each. import rgbd reads them back.
    Example: robot-gst export tum runs/demo/episodes/scan.mcap scan_tum --camera wrist

    Args:
        episode: An episode file with colour, depth and transforms.
        out: The folder to make.
        camera: Only this camera.
        color: recorded keeps JPEG bytes as they are; png decodes them.
        force: Replace an earlier export.
        output: How to talk.
    """
    from bridge.episode.reader import Episode
    from bridge.exchange.tum import export_tum as write_tum

    opened = Episode.open(episode)
    images = sum(item.count for topic, item in opened.topics().items() if topic.endswith("/image"))
    with output.progress("export", images) as advance:
        reports = write_tum(opened, out, camera=camera, color=color, force=force, advance=advance)
    data = [
        {
            "folder": report.folder,
            "colors": len(report.colors),
            "depths": len(report.depths),
            "depth_pixels_too_far": report.depth_too_far,
        }
        for report in reports
    ]
    lines = []
    for report in reports:
        line = f"{len(report.colors)} colour and {len(report.depths)} depth images"
        if report.depth_too_far:
            line += f"; {report.depth_too_far} depths beyond 13.107 m do not fit and are left out"
        lines.append(line if len(reports) == 1 else f"{report.folder}: {line}")
    output.result({"out": str(out), "cameras": data}, "\n".join([f"{out}:", *lines]))
    return 0


def export_csv(
    source: Path,
    out: Path,
    /,
    *,
    derived: bool = False,
    force: bool = False,
    output: Output = OUTPUT,
) -> int:
    """Write an episode, or all of a run, as tidy CSV files: joints, gripper, poses, events ...

    Numbers read back exactly; robot_gst_export.json in OUT explains every column.
    Example: robot-gst export csv runs/demo tables

    Args:
        source: An episode file, or a run folder.
        out: The folder to make.
        derived: Also the replays and localisations of the run.
        force: Replace an earlier export.
        output: How to talk.
    """
    from bridge.exchange.csv_export import episode_files
    from bridge.exchange.csv_export import export_csv as write_csv

    files, _ = episode_files(source, derived=derived)
    with output.progress("export", len(files)) as advance:
        rows = write_csv(source, out, derived=derived, force=force, advance=advance)
    lines = [f"{out}: {len(files)} episodes"]
    lines += [f"  {name:<14} {count:>9} rows" for name, count in sorted(rows.items())]
    output.result({"out": str(out), "episodes": len(files), "rows": rows}, "\n".join(lines))
    return 0


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

    Depth is left out, the format has no place for it. README.md in OUT says what each column is.
    Example: robot-gst export lerobot runs/demo datasets/demo --fps 30

    Args:
        source: A run folder, or one episode file.
        out: The folder to make.
        config: Rate, actions, which episodes.
        force: Replace an earlier export.
        output: How to talk.
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
    output: Output = OUTPUT,
) -> int:
    """Turn a LeRobotDataset v3.0 into episodes: joints, actions, images, one file per episode.

    Episodes already imported are passed over, so an interrupted import goes on where it stopped.
    Example: robot-gst import lerobot datasets/pusht runs/pusht --episodes 0-9

    Args:
        folder: The dataset: the folder with meta/info.json.
        run: Run folder; made where needed.
        cell: Name of the cell in topics.
        episodes: Which ones, for example 0-9,12; all without it.
        output: How to talk.
    """
    from bridge.episode.run import RunFolder
    from bridge.exchange.lerobot.importing import import_lerobot as read_dataset
    from bridge.exchange.lerobot.layout import read_info
    from bridge.exchange.lerobot.reader import parse_selection, read_episodes
    from bridge.sources.names import refuse_bad_name

    refuse_bad_name("cell", cell)
    wanted = parse_selection(episodes)
    total = len(read_episodes(read_info(folder), wanted))
    with output.progress("import", total) as advance:
        report = read_dataset(
            folder, RunFolder.create(run), cell=cell, wanted=wanted, advance=advance
        )
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


def import_trials(
    table: Path, run: Path, /, *, force: bool = False, output: Output = OUTPUT
) -> int:
    """Check a trials CSV and keep it in the run as notes/trials.csv, where evaluate reads it.

    A trial whose id is also that of a recorded episode does not count twice: the episode wins.
    Example: robot-gst import trials experiment.csv runs/monday

    Args:
        table: One row per trial; docs/exchange.md lists the columns.
        run: Run folder; made where needed.
        force: Replace trials imported earlier.
        output: How to talk.
    """
    from bridge.episode.run import RunFolder
    from bridge.exchange.trials_import import import_trials as keep_trials
    from bridge.exchange.trials_import import trials_path

    folder = RunFolder(run)
    trials = keep_trials(table, folder, force=force)
    tasks = sorted({trial.task for trial in trials})
    data = {"file": str(trials_path(folder)), "trials": len(trials), "tasks": tasks}
    output.result(data, f"{trials_path(folder)}: {len(trials)} trials of {', '.join(tasks)}")
    return 0
