"""Commands about episodes on disk, and the doctor."""

from dataclasses import asdict
from pathlib import Path

from bridge.terminal import Output

OUTPUT = Output()


def info(episode: Path, /, *, output: Output = OUTPUT) -> int:
    """Show what an episode holds.

    Example: robot-gst info runs/demo/episodes/trial_0001.mcap

    Args:
        episode: An episode file, recorded or derived.
        output: How to talk.
    """
    from bridge.episode.reader import Episode

    opened = Episode.open(episode)
    topics = opened.topics()
    outcome = opened.outcome
    data = {
        "file": str(episode),
        "info": asdict(opened.info),
        "outcome": asdict(outcome) if outcome else None,
        "derived": asdict(opened.derived) if opened.derived else None,
        "software": opened.metadata_records.get("software", {}),
        "duration_s": opened.duration_s,
        "parts": [str(path) for path in opened.parts],
        "missing_parts": [str(path) for path in opened.missing_parts],
        "recovered": opened.metadata_records.get("recovered"),
        "topics": [asdict(item) for item in topics.values()],
    }
    about = opened.info
    lines = [
        f"{episode.name}: {about.kind} {about.task} {about.condition}".rstrip(),
        f"  {'stand-in cell' if about.stand_in else 'cell'} {about.cell or 'not named'}, "
        f"{opened.duration_s:.1f} s, {sum(item.count for item in topics.values())} messages, "
        f"{sum(path.stat().st_size for path in opened.parts) / 1e6:.1f} MB"
        + (f" in {len(opened.parts)} parts" if len(opened.parts) > 1 else ""),
        f"  outcome: {outcome.result if outcome else 'not labelled'}",
    ]
    if opened.derived:
        derived = opened.derived
        lines.append(
            f"  derived: {derived.kind} of {derived.source_episode} "
            f"{derived.trajectory or ''} {derived.mode or ''} {derived.engine or ''}".rstrip()
        )
    if "recovered" in opened.metadata_records:
        lines.append(
            "  recovered: its recorder died, and the end is lost; robot-gst check says more"
        )
    if opened.missing_parts:
        lines.append(f"  missing: {', '.join(path.name for path in opened.missing_parts)}")
    width = max((len(topic) for topic in topics), default=0)
    lines += [
        f"  {item.topic:<{width}}  {item.count:>7}  {item.type_name}" for item in topics.values()
    ]
    output.result(data, "\n".join(lines))
    return 0


def check(episodes: list[Path], /, *, rerun: bool = False, output: Output = OUTPUT) -> int:
    """Check that episodes are whole: CRCs, indexes, counts, decoding, and losses they declare.

    Exit code 0 clean, 3 losses, 1 broken. Example: robot-gst check runs/demo

    Args:
        episodes: Episode files, or folders to search for them; parts go with their episode.
        rerun: Let Rerun's own checker read each file too.
        output: How to talk.
    """
    from bridge.episode.check import check_all
    from bridge.errors import UsageError

    files: list[Path] = []
    unfinished: list[Path] = []
    for path in episodes:
        if path.is_dir():
            files.extend(sorted(path.rglob("*.mcap")))
            unfinished.extend(sorted(path.rglob("*.mcap.part")))
        else:
            (unfinished if path.suffix == ".part" else files).append(path)
    for path in unfinished:
        output.say(
            f"{path} is not finished: it is being written, or its writer was killed. "
            f"Then robot-gst recover {path}"
        )
    if not files and not unfinished:
        listed = ", ".join(map(str, episodes)) or "no path"
        raise UsageError(f"no episodes in {listed}. Record some: robot-gst record RUN.")
    reports = []
    with output.progress("check", len(files)) as advance:
        for report in check_all(files, rerun=rerun):
            reports.append(report)
            advance(min(len(reports), len(files)), report.path.name)
    data = {
        "episodes": [report.to_json() for report in reports],
        "unfinished": [str(path) for path in unfinished],
    }
    lines = [line for report in reports for line in report.lines()]
    output.result(data, "\n".join(lines))
    codes = {report.exit_code for report in reports}
    codes |= {1 for path in episodes if path.suffix == ".part"}
    return 1 if 1 in codes else max(codes, default=0)


def doctor(*, output: Output = OUTPUT) -> int:
    """Say what is installed, what is missing, and how to get it.

    Example: robot-gst doctor

    Args:
        output: How to talk.
    """
    from bridge.doctor import examine

    findings = examine()
    lines = [
        f"{'ok  ' if item.ok else 'MISS'} {item.what:<28} {item.found:<12} {item.advice}".rstrip()
        for item in findings
    ]
    output.result({"findings": [asdict(item) for item in findings]}, "\n".join(lines))
    return 0 if all(item.ok for item in findings) else 1
