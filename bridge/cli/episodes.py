"""Commands about episodes on disk, alone or all of a run, and the doctor."""

import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from bridge.episode.catalogue_query import UNLABELLED, CatalogueQuery
from bridge.terminal import Output

if TYPE_CHECKING:
    from bridge.episode.catalogue_query import Entry
    from bridge.episode.metadata import Outcome
    from bridge.episode.recovery_report import RecoveryReport

OUTPUT = Output()


def info(episode: Path, /, *, output: Output = OUTPUT) -> int:
    """Show what an episode holds.

    Example: robot-gst info runs/demo/episodes/trial_0001.mcap

    Args:
        episode: An episode file, recorded or derived.
    """
    from bridge.episode.clocks import clocks_of
    from bridge.episode.contract import PRESENCE_RECORD, health_lines
    from bridge.episode.health import RECORD_NAME
    from bridge.episode.reader import Episode
    from bridge.task.find import HASH_DIGITS

    opened = Episode.open(episode)
    topics = opened.topics()
    outcome = opened.outcome
    clocks = clocks_of(opened)
    health = {"findings": opened.metadata_records.get(RECORD_NAME, {}).get("findings", [])}
    data = {
        "file": str(episode),
        "info": asdict(opened.info),
        "outcome": asdict(outcome) if outcome else None,
        "derived": asdict(opened.derived) if opened.derived else None,
        "software": opened.metadata_records.get("software", {}),
        "duration_s": opened.duration_s,
        "recovered": opened.metadata_records.get("recovered"),
        "presence": opened.metadata_records.get(PRESENCE_RECORD),
        "findings": health["findings"],
        "clocks": [clock.sentences() for clock in clocks],
        "topics": [asdict(item) for item in topics.values()],
    }
    about = opened.info
    lines = [
        f"{episode.name}: {about.kind} {about.task} {about.condition}".rstrip(),
        f"  {'stand-in cell' if about.stand_in else 'cell'} {about.cell or 'not named'}, "
        f"{opened.duration_s:.1f} s, {sum(item.count for item in topics.values())} messages, "
        f"{episode.stat().st_size / 1e6:.1f} MB",
        f"  outcome: {_outcome('replay' if opened.derived else about.kind, outcome)}",
    ]
    if about.task and not opened.derived:
        digits = about.task_sha256[:HASH_DIGITS]
        lines.append(f"  task file: {f'attached, sha256 {digits}' if digits else 'none attached'}")
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
    presence = opened.metadata_records.get(PRESENCE_RECORD, {})
    lines += [f"  {text}" for text in health_lines({**presence, **health}, opened.start_ns)]
    lines += [f"  {text}" for clock in clocks for text in clock.sentences()]
    width = max((len(topic) for topic in topics), default=0)
    seen = presence.get("topics")
    shown = seen if isinstance(seen, dict) else {}
    lines += [
        f"  {item.topic:<{width}}  {count:>7}  {name}{_when(shown.get(item.topic))}"
        for item in topics.values()
        for name, count in (item.types or {item.type_name: item.count}).items()
    ]
    output.result(data, "\n".join(lines))
    return 0


def _when(report: object) -> str:
    """From when to when a topic was there, its longest silence, and how many were expected."""
    if not isinstance(report, dict) or not isinstance(report.get("first_s"), int | float):
        return ""
    text = f"  {report['first_s']:.1f} to {report['last_s']:.1f} s"
    if report.get("longest_silence_s"):
        text += f", silent up to {report['longest_silence_s']:.2f} s"
    return text + (f", {report['expected']} expected" if report.get("expected") else "")


def _outcome(kind: str, outcome: "Outcome | None") -> str:
    """How it ended, and why nobody knows where nobody does."""
    if outcome is None:
        return f"unknown ({UNLABELLED})" if kind == "trial" else f"none (a {kind} has none)"
    unknown = outcome.result == "unknown" and outcome.detail
    return f"{outcome.result} ({outcome.detail})" if unknown else outcome.result


def check(
    episodes: tuple[Path, ...] = (),
    /,
    *,
    contract: str | None = None,
    output: Output = OUTPUT,
) -> int:
    """Verify episodes (CRCs, indexes, counts, decoding); list drops and silent topics.

    Exit code 0: clean, 3: messages were dropped or a contract was broken, 1: broken.
    Example: robot-gst check runs/demo

    Args:
        episodes: Episode files, or folders to search for them.
        contract: Hold them to this TOML file or template, not to what they were recorded under.
    """
    from bridge.episode.check import check_episode
    from bridge.episode.contract import find_contract
    from bridge.episode.mcap.part_file import told_unfinished
    from bridge.errors import UsageError

    files: list[Path] = []
    unfinished: list[Path] = []
    for path in episodes:
        if path.is_dir():
            files.extend(sorted(path.rglob("*.mcap")))
            unfinished.extend(sorted(path.rglob("*.mcap.part")))
        else:
            (unfinished if path.suffix == ".part" else files).append(path)
    told = [told_unfinished(path) for path in unfinished]
    for text, _ in told:
        output.say(text)
    if not files and not unfinished:
        listed = ", ".join(map(str, episodes)) or "no path"
        raise UsageError(f"no episodes in {listed}. Record some: robot-gst record RUN.")
    reports = []
    with output.progress("check", len(files)) as advance:
        asked = None if contract is None else find_contract(Path(), contract)
        for path in dict.fromkeys(files):
            reports.append(check_episode(path, contract=asked))
            advance(len(reports), path.name)
    data = {
        "episodes": [report.to_json() for report in reports],
        "unfinished": [str(path) for path in unfinished],
    }
    lines = [line for report in reports for line in report.lines()]
    output.result(data, "\n".join(lines))
    codes = {report.exit_code for report in reports}
    left = [path for path, (_, alive) in zip(unfinished, told, strict=True) if not alive]
    codes |= {1 if path in episodes else 3 for path in left}
    return 1 if 1 in codes else max(codes, default=0)


def doctor(*, output: Output = OUTPUT) -> int:
    """Show what is installed, what is missing, and how to get it.

    Example: robot-gst doctor
    """
    from bridge.doctor import examine

    findings = examine()
    lines: list[str] = []
    purpose = ""
    for item in findings:
        if item.purpose != purpose:
            lines.append(item.purpose or "built here, and found on this machine")
            purpose = item.purpose
        line = f"{'ok  ' if item.ok else 'MISS'} {item.what:<28} {item.found:<12}"
        apart = "\n     " if len(line) + len(item.advice) >= 80 else " "
        lines.append(f"{line.rstrip()}{apart}{item.advice}".rstrip())
    output.result({"findings": [asdict(item) for item in findings]}, "\n".join(lines))
    return 0 if all(item.ok for item in findings) else 1


def recover(paths: list[Path], /, *, output: Output = OUTPUT) -> int:
    """Repair files whose writer was killed, and report what was lost.

    Exit code 0: repaired, 1: nothing could be read in one of them.
    Example: robot-gst recover runs/monday

    Args:
        paths: Files of any MCAP writer, or folders to search for ``*.mcap.part``.
    """
    from bridge.episode import recover as recovery
    from bridge.episode.recovery_report import RecoveryReport
    from bridge.errors import GstError, UsageError

    files: list[Path] = []
    for path in paths:
        if path.is_dir() and not any(path.rglob("*.mcap*")):
            raise UsageError(f"no episodes in {path}. Give a run folder, or a file to recover.")
        files.extend(sorted(path.rglob("*.mcap.part")) if path.is_dir() else [path])
    reports = []
    for path in files:
        try:
            reports.append(recovery.recover(path))
        except GstError as error:
            if len(files) == 1:
                raise
            reports.append(RecoveryReport(path=path, output=None, reason=str(error)))
    lines = [_describe(report) for report in reports]
    text = "\n".join(lines) or "nothing to recover: every file is finished"
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


EVERYTHING = CatalogueQuery()


def ls(
    run: Path,
    /,
    *,
    query: Annotated[CatalogueQuery, Parameter(name="*")] = EVERYTHING,
    output: Output = OUTPUT,
) -> int:
    """List the episodes of a run, or those that pass the filters.

    Exit code 1 when one of them cannot be read.
    Example: robot-gst ls runs/demo --kind trial --outcome failure --text "cube slipped"

    Args:
        run: Run folder.
        query: Which.
    """
    from bridge.episode.catalogue import find_episodes
    from bridge.episode.mcap.part_file import told_unfinished
    from bridge.episode.run_folder import RunFolder

    opened = RunFolder.open(run)
    for path in sorted(opened.episodes_dir.glob("*.part")):
        output.say(told_unfinished(path)[0])
    opened.refuse_empty()
    entries = find_episodes(opened, query)
    lines = episode_table(entries) if entries else [f"no episode in {run} passes these filters"]
    output.result({"episodes": [vars(entry) for entry in entries]}, "\n".join(lines))
    return 1 if any(entry.error for entry in entries) else 0


COLUMNS = ("episode", "kind", "condition", "outcome", "seconds", "MB")
WIDEST = 26
"""Of an episode's name beside the other columns; a longer one has a line of its own."""


WRAPPED = textwrap.TextWrapper(
    80, initial_indent="    ", subsequent_indent="    ", break_long_words=False
)


def episode_table(entries: "list[Entry]") -> list[str]:
    """A header, a row for each episode within 80 columns, and below it what is special about it."""
    rows = [COLUMNS, *(_row(entry) for entry in entries)]
    widths = [
        max(len(row[k]) for row in rows if len(row[k]) <= WIDEST) for k in range(len(COLUMNS))
    ]
    all_stand_in = all(entry.stand_in for entry in entries)
    lines = ["all from the stand-in cell"] if all_stand_in else []
    for row, entry in zip(rows, [None, *entries], strict=True):
        name = row[0]
        if len(name) > WIDEST:
            lines.append(name)
            name = ""
        cells = [name.ljust(widths[0])]
        cells += [text.ljust(width) for text, width in zip(row[1:4], widths[1:4], strict=True)]
        cells += [text.rjust(width) for text, width in zip(row[4:], widths[4:], strict=True)]
        lines.append("  ".join(cells).rstrip())
        if entry is not None:
            lines += WRAPPED.wrap(_notes(entry, is_named=not all_stand_in))
    return lines


def _row(entry: "Entry") -> tuple[str, ...]:
    outcome = _shown(entry.outcome)
    if entry.outcome == "unknown" and entry.cause in ("", UNLABELLED):
        outcome = "unlabelled" if entry.cause else "-"
    return (
        _shown(entry.id),
        _shown(entry.kind) or "-",
        _shown(entry.condition) or "-",
        outcome,
        f"{entry.duration_s:.1f}",
        f"{entry.size_bytes / 1e6:.1f}",
    )


def _notes(entry: "Entry", *, is_named: bool) -> str:
    """What is special about an episode, and why its outcome is unknown."""
    notes = [f"{entry.lost} messages lost"] if entry.lost else []
    notes += ["recovered, its end is missing"] if entry.recovered else []
    notes += ["from the stand-in cell"] if entry.stand_in and is_named else []
    if entry.cause and entry.cause != UNLABELLED:
        notes.append(f"unknown: {_shown(entry.cause)}")
    if entry.presence:
        notes.append(_shown(entry.presence, 400))
    return "; ".join(notes + ([_shown(entry.error)] if entry.error else []))


def _shown(text: str, most: int = 200) -> str:
    """Text of other programs without what would move the cursor, and not endless."""
    return "".join(sign if sign.isprintable() else "?" for sign in text[:most])


def label(
    run: Path,
    episode: str,
    /,
    *,
    result: Literal["success", "failure", "unknown"] | None = None,
    task: str | None = None,
    start: str | None = None,
    policy: str | None = None,
    by: str = "operator",
    detail: str | None = None,
    output: Output = OUTPUT,
) -> int:
    """Say how a recorded episode ended, and of what it is a trial; nothing is rewritten.

    With --task, an imported episode is a trial from then on. Kept in notes/.
    Example: robot-gst label runs/monday trial_0003 --result failure --detail "slipped"
    Example: robot-gst label runs/monday bag_7 --task cube_into_box --result success --policy act

    Args:
        run: Run folder.
        episode: Id of the episode: its file name without .mcap.
        result: success, failure or unknown.
        task: Name or file of the task it is a trial of.
        start: Id of the start that it shares with other trials; with --task.
        policy: What moved the robot; with --task.
        by: Who says so.
        detail: What happened, in words.
    """
    from bridge.episode.catalogue import assign_trial, label_episode, refuse_without_task
    from bridge.episode.metadata import Outcome
    from bridge.episode.run_folder import RunFolder
    from bridge.errors import UsageError

    if task is None and (start or policy):
        raise UsageError("--start and --policy belong to a trial: add --task NAME.")
    if result is None and task is None:
        raise UsageError("say what to note: --result success, --task NAME, or both.")
    opened = RunFolder.open(run)
    data: dict[str, object] = {}
    said = []
    if task is not None:
        note = assign_trial(opened, episode, task=task, start_id=start, policy=policy)
        data |= {"task": task, "start": start, "policy": policy, "note": str(note)}
        said.append(f"a trial of {task} ({note})")
    if result is not None:
        refuse_without_task(opened, episode)
        outcome = Outcome(result=result, k=int(result == "success"), n=1, by=by, detail=detail)
        path = label_episode(opened, episode, outcome)
        data |= {"label": asdict(outcome), "file": str(path)}
        said.append(f"{result} ({path})")
    output.result(data, f"{episode}: {', '.join(said)}")
    return 0
