"""Commands that bring other people's recordings into a run."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.episode.message import StampedMessage
from bridge.sources.folder_config import FolderConfig
from bridge.terminal import Output

OUTPUT = Output()
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
    """Turn an RGB-D folder into a scan episode: scene.json, TUM or 7-Scenes layout.

    The layout is found by the files. TUM folders keep their real times and all their poses.
    Example: robot-gst import rgbd data/kitchen runs/kitchen --cell kitchen --camera kinect

    Args:
        folder: Folder of one of the three layouts (docs/rgbd_folder.md).
        run: Run folder; made where needed.
        episode: Id of the new episode.
        config: Names and rate.
        output: How to talk.
    """
    from bridge.episode.metadata import EpisodeInfo
    from bridge.episode.run import RunFolder
    from bridge.exchange.rgbd import write_scan
    from bridge.sources.folder import describe_folder, folder_messages, num_frames
    from bridge.sources.folder_index import read_index

    index = read_index(folder, config)
    output.say(f"{index.path}: {index.summary}")
    for name, value in index.assumed.items():
        output.say(f"  assumed {name.replace('_', ' ')}: {value}")
    info = EpisodeInfo(id=episode, kind="scan", cell=config.cell, tags=(f"folder:{index.name}",))
    source = describe_folder(index, config)
    total = num_frames(index, config)

    with output.progress("import", total) as advance:

        def messages() -> Iterator[StampedMessage]:
            for done, frame in enumerate(folder_messages(index, config, None), start=1):
                yield from frame
                advance(done, "")

        path = write_scan(RunFolder.create(run), info, messages(), source=source)
    left_out = index.num_unposed + index.num_unpaired
    data = {
        "file": str(path),
        "layout": index.layout,
        "frames": total,
        "frames_left_out": left_out,
        "assumed": index.assumed,
    }
    output.result(data, f"{path}: {total} frames of a folder in {index.layout} layout")
    return 0


def import_kinova(folder: Path, run: Path, /, *, output: Output = OUTPUT) -> int:
    """Turn the Kinova reality-gap runs into episodes: real ones recorded, simulated ones derived.

    Example: robot-gst import kinova data/kinova runs/kinova

    Args:
        folder: Folder with real/Experiment1/*.tsv and sim/Experiment1/*.csv.
        run: Run folder; made where needed.
        output: How to talk.
    """
    from bridge.episode.run import RunFolder
    from bridge.exchange.kinova import find_runs, import_runs

    real, simulated = find_runs(folder)
    files = []
    with output.progress("import", len(real) + len(simulated)) as advance:
        for path, _ in import_runs(folder, RunFolder.create(run)):
            files.append(str(path))
            advance(len(files), path.name)
    data = {"real": len(real), "simulated": len(simulated), "files": files}
    output.result(data, f"{len(real)} real and {len(simulated)} simulated runs in {run}")
    return 0


def import_rosbag2(
    bag: Path, run: Path, /, *, episode: str | None = None, output: Output = OUTPUT
) -> int:
    """Turn a rosbag2 recording in MCAP into an episode; every message stays byte for byte.

    Example: robot-gst import rosbag2 bags/monday runs/monday

    Args:
        bag: A .mcap file, or the folder with metadata.yaml, split files included.
        run: Run folder; made where needed.
        episode: Id of the new episode; by default from the name of the bag.
        output: How to talk.
    """
    import re

    from bridge.episode.run import RunFolder
    from bridge.exchange.rosbag2 import count_messages, import_bag

    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", bag.resolve().name.removesuffix(".mcap")).strip("_-")
    total = count_messages(bag)
    with output.progress("import", total) as advance:
        report = import_bag(
            bag, RunFolder.create(run), episode_id=episode or plain or "bag", advance=advance
        )
    data = {
        "file": str(report.path),
        "bag_files": report.files,
        "messages": report.messages,
        "topics": report.topics,
    }
    output.result(
        data,
        f"{report.path}: {report.messages} messages on {len(report.topics)} topics "
        f"of {len(report.files)} files",
    )
    return 0
