"""Commands that exchange data with other people's programs."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.clock import ClockChoice
from bridge.episode.schema import StampedMessage
from bridge.sources.folder.config import FolderConfig
from bridge.terminal import RARE, Output

OUTPUT = Output()


def export_tum(
    episode: Path,
    out: Path,
    /,
    *,
    camera: str | None = None,
    clock: ClockChoice = "recorded",
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
        clock: corrected takes offset and drift of the sources' clocks out of all stamps.
        force: Replace an earlier export.
    """
    from bridge.episode.clocks import open_episode
    from bridge.exchange.rgbd import export_tum as write_tum

    opened = open_episode(episode, clock=clock)
    images = sum(item.count for topic, item in opened.topics().items() if topic.endswith("/image"))
    with output.progress("export", images) as advance:
        reports = write_tum(opened, out, camera=camera, force=force, advance=advance)
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
        line += f"; {report.straightened}" if report.straightened else ""
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
    clock: ClockChoice = "recorded",
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
        clock: corrected takes offset and drift of the sources' clocks out of all stamps.
        force: Replace an earlier export.
    """
    from bridge.exchange.csv_export import episode_files
    from bridge.exchange.csv_export import export_csv as write_csv

    files, _ = episode_files(source, derived=derived)
    with output.progress("export", len(files)) as advance:
        rows = write_csv(source, out, derived=derived, clock=clock, force=force, advance=advance)
    lines = [f"{out}: {len(files)} episodes"]
    lines += [f"  {name:<14} {count:>9} rows" for name, count in sorted(rows.items())]
    output.result({"out": str(out), "episodes": len(files), "rows": rows}, "\n".join(lines))
    return 0


def export_rosbag2(
    episode: Path, out: Path, /, *, force: bool = False, output: Output = OUTPUT
) -> int:
    """Write an episode as a rosbag2 folder: one MCAP file and metadata.yaml.

    ROS 2 messages stay byte for byte, with their definitions, times and numbers.
    Example: robot-gst export rosbag2 runs/demo/episodes/trial_0001.mcap bags/trial_0001

    Args:
        episode: An episode file.
        out: The folder to make.
        force: Replace an earlier export.
    """
    from bridge.episode.reader import Episode
    from bridge.exchange.rosbag2_export import export_bag

    opened = Episode.open(episode)
    total = sum(item.count for item in opened.topics().values())
    with output.progress("export", total) as advance:
        report = export_bag(opened, out, force=force, advance=advance)
    lines = [f"{out}: {report.messages} messages on {len(report.topics)} topics"]
    lines += [f"  left out: {topic} ({why})" for topic, why in report.left_out.items()]
    data = {"out": str(out), "topics": report.topics, "left_out": report.left_out}
    output.result({**data, "messages": report.messages}, "\n".join(lines))
    return 0


FOLDER = FolderConfig()


def import_rgbd(
    folder: Path,
    run: Path,
    /,
    *,
    episode: str = "scan",
    config: Annotated[FolderConfig, Parameter(name="*")] = FOLDER,
    output: Output = OUTPUT,
) -> int:
    """Turn an RGB-D folder into a scan episode: scene.json, transforms.json, TUM, 7-Scenes.

    The layout is found by the files. TUM folders keep their real times and all their poses.
    Example: robot-gst import rgbd data/kitchen runs/kitchen --cell kitchen --camera kinect

    Args:
        folder: Folder of one of the four layouts (docs/rgbd_folder.md).
        run: Run folder; made where needed.
        episode: Id of the new episode.
    """
    from bridge.episode.metadata import EpisodeInfo
    from bridge.episode.run_folder import RunFolder
    from bridge.exchange.output import Unused, tell_unused
    from bridge.exchange.rgbd import write_scan
    from bridge.sources.folder.messages import describe_folder, folder_messages, read_index

    index = read_index(folder, config)
    output.say(f"{index.path}: {index.summary}")
    for name, value in index.assumed.items():
        output.say(f"  assumed {name.replace('_', ' ')}: {value}")
    info = EpisodeInfo(id=episode, kind="scan", cell=config.cell, tags=(f"folder:{index.name}",))
    total = len(index.frames)
    with output.progress("import", total) as advance:

        def messages() -> Iterator[StampedMessage]:
            for done, frame in enumerate(folder_messages(index, config), start=1):
                yield from frame
                advance(done, "")

        source = describe_folder(index, config)
        path = write_scan(RunFolder.create(run), info, messages(), source=source)
    unused = [Unused(*item) for item in index.unused]
    data = {
        "file": str(path),
        "layout": index.layout,
        "frames": total,
        "frames_left_out": index.num_unposed + index.num_unpaired,
        "assumed": index.assumed,
        "unused": [item._asdict() for item in unused],
    }
    output.result(data, f"{path}: {total} frames of a folder in {index.layout} layout")
    return tell_unused(output, unused)


def import_rosbag2(
    bag: Path,
    run: Path,
    /,
    *,
    episode: str | None = None,
    task: str | None = None,
    robot: str | None = None,
    remap: Annotated[tuple[str, ...], RARE] = (),
    output: Output = OUTPUT,
) -> int:
    """Turn a rosbag2 recording into an episode; every message stays byte for byte.

    MCAP or sqlite3; what rosbag2 compressed with zstd, file or message, is unpacked.
    Example: robot-gst import rosbag2 bags/monday runs/monday

    Args:
        bag: A file of a bag, or the folder with metadata.yaml, split files included.
        run: Run folder; made where needed.
        episode: Id of the new episode; by default from the name of the bag.
        task: Name or file of the task it is a trial of.
        robot: Robot file or URDF; the episode carries it, whatever description was recorded.
        remap: OLD=NEW: another name for a topic, such as /front/rgb=/cam/front/color/image.
            Without any, topics of known camera drivers are renamed.
    """
    import re

    from bridge.episode.catalogue import task_of_run
    from bridge.episode.run_folder import RunFolder
    from bridge.exchange.output import tell_unused
    from bridge.exchange.rosbag2 import count_messages, import_bag
    from bridge.robots.robot import read_robot

    stem = re.sub(r"(\.mcap|\.db3)?(\.zstd)?$", "", bag.resolve().name)
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_-")
    total = count_messages(bag)
    opened, name = RunFolder.create(run), episode or plain or "bag"
    of_task = task_of_run(opened, task) if task else ""
    urdf = read_robot(robot).description() if robot else ""
    with output.progress("import", total) as advance:
        report = import_bag(
            bag, opened, episode_id=name, task=of_task, urdf=urdf, remap=remap, advance=advance
        )
    data = {
        "file": str(report.path),
        "bag_files": report.files,
        "messages": report.messages,
        "topics": report.topics,
        "renamed": report.names,
        "unused": [item._asdict() for item in report.unused],
    }
    for old, new in report.names.items():
        output.say(f"  {old} is called {new} in the episode")
    output.result(
        data,
        f"{report.path}: messages: {report.messages}, topics: {len(report.topics)}, "
        f"files: {len(report.files)}",
    )
    return tell_unused(output, report.unused)
