"""Commands that exchange data with other people's programs."""

from pathlib import Path
from typing import Literal

from bridge.terminal import Output

OUTPUT = Output()


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
