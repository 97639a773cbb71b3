"""The command that finishes what a killed recorder left."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from bridge.terminal import Output

if TYPE_CHECKING:
    from bridge.episode.recover import RecoveryReport

OUTPUT = Output()


def recover(paths: list[Path], /, *, in_place: bool = False, output: Output = OUTPUT) -> int:
    """Make readable episodes of files whose writer was killed, and say what was lost.

    Exit code 0 recovered, 1 when nothing could be read in one of them.
    Example: robot-gst recover runs/monday

    Args:
        paths: Files of any MCAP writer, or folders to search for ``*.mcap.part``.
        in_place: Finish the file itself; without it a copy is made where the disk has room.
        output: How to talk.
    """
    from bridge.episode import recover as recovery
    from bridge.errors import GstError

    files: list[Path] = []
    for path in paths:
        files.extend(sorted(path.rglob("*.mcap.part")) if path.is_dir() else [path])
    reports = []
    for path in files:
        try:
            reports.append(recovery.recover(path, in_place=True if in_place else None))
        except GstError as error:
            if len(files) == 1:
                raise
            reports.append(recovery.RecoveryReport(path=path, output=None, reason=str(error)))
    text = "\n".join(_describe(report) for report in reports) or "nothing to recover"
    output.result({"files": [asdict(report) for report in reports]}, text)
    return 1 if any(report.output is None for report in reports) else 0


def _describe(report: "RecoveryReport") -> str:
    if report.output is None:
        return f"{report.path}: nothing could be read ({report.reason})"
    state = "was complete" if report.finished else "recovered"
    lines = [
        f"{report.path.name}: {state}, now {report.output}",
        f"  {report.messages} messages on {len(report.topics)} topics, "
        f"{report.attachments} attachments, {report.bytes_lost} bytes lost",
    ]
    if report.reason:
        lines.append(f"  {report.reason}")
    if report.original is not None:
        lines.append(f"  the damaged original is kept: {report.original}")
    return "\n".join(lines)
