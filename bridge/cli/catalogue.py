"""Commands about all episodes of a run: list, label, export the list."""

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from bridge.episode.catalogue.query import CatalogueQuery
from bridge.terminal import Advance, Output

if TYPE_CHECKING:
    from bridge.episode.catalogue.entry import Entry

OUTPUT = Output()
EVERYTHING = CatalogueQuery()
WORTH_A_BAR = 200
"""New episodes to read before progress is shown."""


def ls(
    run: Path,
    /,
    *,
    query: Annotated[CatalogueQuery, Parameter(name="*")] = EVERYTHING,
    output: Output = OUTPUT,
) -> int:
    """List the episodes of a run, or those that pass the filters.

    Exit code 1 when one of them cannot be read.
    Example: robot-gst ls runs/demo --kind trial --outcome failure --sort start --reverse

    Args:
        run: Run folder.
        query: Which, and in what order.
        output: How to talk.
    """
    entries = _find(run, query, output)
    lines = [_line(entry) for entry in entries]
    if not lines:
        empty = f"no episodes in {run}. Record some: robot-gst record {run}"
        lines = [empty if query == EVERYTHING else f"no episode in {run} passes these filters"]
    output.result({"episodes": [vars(entry) for entry in entries]}, "\n".join(lines))
    return 1 if any(entry.error for entry in entries) else 0


def _find(run: Path, query: CatalogueQuery, output: Output) -> "list[Entry]":
    from bridge.episode.catalogue.find import find_episodes
    from bridge.episode.run import RunFolder

    with ExitStack() as stack:
        shown: list[Advance] = []

        def advance(done: int, total: int) -> None:
            if not shown and total > WORTH_A_BAR:
                shown.append(stack.enter_context(output.progress("read episodes", total)))
            for show in shown:
                show(done, "")

        return find_episodes(RunFolder.open(run), query, advance=advance)


def _line(entry: "Entry") -> str:
    flags = [f"{entry.parts} parts"] if entry.parts > 1 else []
    flags += [f"{entry.lost} lost"] if entry.lost else []
    flags += [
        text
        for text, there in (
            ("recovered, tail missing", entry.recovered),
            ("stand-in", entry.stand_in),
            (_shown(entry.error), entry.error),
        )
        if there
    ]
    return (
        f"{_shown(entry.id):<28} {_shown(entry.kind):<9} {_shown(entry.condition):<20} "
        f"{_shown(entry.outcome):<8} {entry.duration_s:7.1f} s {entry.size_bytes / 1e6:7.1f} MB"
        f"{'  ' + ', '.join(flags) if flags else ''}"
    )


def _shown(text: str, most: int = 200) -> str:
    """Text of other programs without what would move the cursor, and not endless."""
    text = text[:most]
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else "?" for sign in text)


def label(
    run: Path,
    episode: str,
    /,
    *,
    result: Literal["success", "failure", "unknown"],
    by: str = "operator",
    detail: str | None = None,
    output: Output = OUTPUT,
) -> int:
    """Say after the fact how an episode ended; kept in notes/, the episode is not rewritten.

    Example: robot-gst label runs/monday trial_0003 --result failure --detail "slipped"

    Args:
        run: Run folder.
        episode: Id of the episode: its file name without .mcap.
        result: success, failure or unknown.
        by: Who says so.
        detail: What happened, in words.
        output: How to talk.
    """
    from bridge.episode.catalogue import label_episode
    from bridge.episode.metadata import Outcome
    from bridge.episode.run import RunFolder

    outcome = Outcome(result=result, k=int(result == "success"), n=1, by=by, detail=detail)
    path = label_episode(RunFolder.open(run), episode, outcome)
    output.result({"label": asdict(outcome), "file": str(path)}, f"{episode}: {result} ({path})")
    return 0


def export_catalogue(
    run: Path,
    out: Path,
    /,
    *,
    query: Annotated[CatalogueQuery, Parameter(name="*")] = EVERYTHING,
    output: Output = OUTPUT,
) -> int:
    """Write the list of a run's episodes as a Parquet table, one row per episode.

    Example: robot-gst export catalogue runs/monday monday.parquet --kind trial

    Args:
        run: Run folder.
        out: The Parquet file to write; replaced if it is there.
        query: Which, and in what order.
        output: How to talk.
    """
    from bridge.episode.catalogue.parquet import write_parquet

    entries = _find(run, query, output)
    write_parquet(entries, out)
    output.result({"file": str(out), "episodes": len(entries)}, f"{out}: {len(entries)} episodes")
    return 0
