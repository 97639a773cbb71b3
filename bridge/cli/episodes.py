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
        "topics": [asdict(item) for item in topics.values()],
    }
    about = opened.info
    lines = [
        f"{episode.name}: {about.kind} {about.task} {about.condition}".rstrip(),
        f"  {'stand-in cell' if about.stand_in else 'cell'} {about.cell or 'not named'}, "
        f"{opened.duration_s:.1f} s, {sum(item.count for item in topics.values())} messages, "
        f"{episode.stat().st_size / 1e6:.1f} MB",
        f"  outcome: {outcome.result if outcome else 'not labelled'}",
    ]
    if opened.derived:
        derived = opened.derived
        lines.append(
            f"  derived: {derived.kind} of {derived.source_episode} "
            f"{derived.trajectory or ''} {derived.mode or ''} {derived.engine or ''}".rstrip()
        )
    width = max((len(topic) for topic in topics), default=0)
    lines += [
        f"  {item.topic:<{width}}  {item.count:>7}  {item.type_name}" for item in topics.values()
    ]
    output.result(data, "\n".join(lines))
    return 0


def check(episodes: list[Path], /, *, output: Output = OUTPUT) -> int:
    """Check that episodes are whole: CRCs, decoding, counts, and losses they declare.

    Exit code 0 clean, 3 declared losses, 1 broken. Example: robot-gst check runs/demo

    Args:
        episodes: Episode files, or folders to search for them.
        output: How to talk.
    """
    from bridge.episode.check import check_episode
    from bridge.errors import UsageError

    files: list[Path] = []
    for path in episodes:
        files.extend(sorted(path.rglob("*.mcap")) if path.is_dir() else [path])
        for part in sorted(path.rglob("*.mcap.part")) if path.is_dir() else []:
            output.say(f"{part} is not finished: still being written, or its writer was killed")
    if not files:
        listed = ", ".join(map(str, episodes)) or "no path"
        raise UsageError(f"no episodes in {listed}. Record some: robot-gst record RUN.")
    reports = [check_episode(path) for path in files]
    lines = []
    for report in reports:
        lines.append(
            f"{report.path.name}: {report.summary}, {report.messages} messages, "
            f"{report.declared_losses} declared lost"
        )
        lines += [f"  {fault}" for fault in report.faults]
    data = {
        "episodes": [
            {
                "file": str(report.path),
                "state": report.summary,
                "messages": report.messages,
                "declared_losses": report.declared_losses,
                "faults": report.faults,
            }
            for report in reports
        ]
    }
    output.result(data, "\n".join(lines))
    codes = {report.exit_code for report in reports}
    return 1 if 1 in codes else max(codes)


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
