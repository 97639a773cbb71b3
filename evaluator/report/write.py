"""Put one comparison on disk: results.json, tables, figures, report.html, trials.csv, Parquet."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bridge.exchange.trials_csv import TrialRecord, write_trials
from bridge.whole_file import write_whole
from evaluator.compare.rows import Comparison
from evaluator.compare.spreadsheet import record_from_row
from evaluator.errors import EvaluatorError
from evaluator.report.figures import drawings_of
from evaluator.report.page import name_shared, page
from evaluator.report.sections import FIGURES, shown_tables
from evaluator.report.tables import as_csv, as_latex, as_text
from evaluator.report.wording import STAND_IN, headlines
from evaluator.result import Results, Table, write_results

SHOWN = ("published", "success", "comparisons", "standing", "image_methods", "notes")
"""Tables a terminal shows; the others are in the report."""
MOST_COMPARISONS = 12
"""That it shows; ten policies in three tasks are compared 180 times."""

GROUPS = "success"
"""The table of success rates; ``groups.parquet`` holds it too."""

HEADLINE_TABLES = ("conclusions", "success", "comparisons", "confusion")
"""Those that ``--latex`` writes for a paper."""
PARQUET_PACKAGES = ("pyarrow",)
LATEX_PACKAGES = ("pandas", "jinja2")
INSTALL = "pip install 'robot-gst[report]'"


@dataclass(frozen=True, kw_only=True)
class Written:
    """Where everything lies, and what was said."""

    content: Results
    """What ``results.json`` holds."""
    results: Path
    report: Path
    files: tuple[Path, ...]
    not_written: str | None = None
    """Which packages are not installed and what is missing for it, or None."""


def write_report(
    comparison: Comparison, folder: Path, *, everything: bool = False, latex: bool = False
) -> Written:
    """Write every file of one evaluation into ``folder``, replacing an earlier one."""
    drawn = drawings_of(comparison)
    results = comparison.results()
    old = _old_files(folder)
    path = write_results(results, folder / "results.json")
    try:
        tables, no_latex = _table_files(folder, results, everything=everything, latex=latex)
        trials = [record_from_row(row) for row in comparison.rows]
        extra = [write_trials(folder / "trials.csv", trials)] if trials else []
        parquet, no_parquet = _write_parquet(folder, trials, results)
        text = page(results, drawn, everything=everything)
        figures = {folder / "figures" / f"{each.id}.svg": each.svg.encode() for each in drawn}
        files = {folder / "report.html": text.encode()} | figures | tables
        for place, data in files.items():
            place.parent.mkdir(parents=True, exist_ok=True)
            write_whole(place, data)
        name_shared(folder / "report.html")
        for one in set(old) - {*files, *extra, *parquet}:
            one.unlink(missing_ok=True)
    except OSError as error:
        message = f"cannot write into {folder}: {error.strerror}. Choose another with --out."
        raise EvaluatorError(message) from error
    return Written(
        content=results,
        results=path,
        report=folder / "report.html",
        files=(*files, *extra, *parquet),
        not_written="; ".join(filter(None, (no_parquet, no_latex))) or None,
    )


def _table_files(
    folder: Path, results: Results, *, everything: bool, latex: bool
) -> tuple[dict[Path, bytes], str | None]:
    """Return the tables as CSV, the headline tables as LaTeX, and why the latter are missing."""
    shown = shown_tables(results, everything=everything)
    files = {folder / "tables" / f"{table.id}.csv": as_csv(table).encode() for table in shown}
    try:
        for table in results.tables if latex else ():
            if table.id in HEADLINE_TABLES:
                files[folder / "tables" / f"{table.id}.tex"] = as_latex(table).encode()
    except ModuleNotFoundError as error:
        if error.name not in LATEX_PACKAGES:
            raise
        return files, f"LaTeX not written: {error.name} is not installed ({INSTALL})"
    return files, None


def _old_files(folder: Path) -> list[Path]:
    """List what an earlier evaluation may have written; only what it says is its own.

    A paper that includes a table would else go on to print the numbers of another evaluation.
    """
    try:
        tables = json.loads((folder / "results.json").read_bytes())["tables"]
        named = [str(table["id"]) for table in tables]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []  # nothing of ours
    files = [folder / "tables" / f"{name}.{end}" for name in named for end in ("csv", "tex")]
    files += [folder / "figures" / f"{name}.svg" for name in FIGURES]
    ours = ("trials.csv", "trials.parquet", "groups.parquet", "measurements.parquet")
    return [*files, *(folder / name for name in ours)]


def _write_parquet(
    folder: Path, trials: Sequence[TrialRecord], results: Results
) -> tuple[list[Path], str | None]:
    """Write the Parquet files, or say why not; pyarrow is heavy and may be missing."""
    try:
        from evaluator.report import parquet  # noqa: PLC0415  # loads pyarrow only when writing
    except ModuleNotFoundError as error:
        if error.name not in PARQUET_PACKAGES:
            raise
        lacking = f"{error.name} is not installed ({INSTALL})"
        return [], f"trials, groups and measurements.parquet not written: {lacking}"
    written = [parquet.write_measurements(folder / "measurements.parquet", results.measurements)]
    groups = next((table for table in results.tables if table.id == GROUPS), None)
    if groups is not None:
        written.append(parquet.write_table(folder / "groups.parquet", groups))
    if trials:
        written.append(parquet.write_trials(folder / "trials.parquet", trials))
    return written, None


def _beginning(table: Table) -> Table:
    """The first of many comparisons, those that are decided before the others."""
    more = len(table.rows) - MOST_COMPARISONS
    if table.id != "comparisons" or more <= 0:
        return table
    at = table.columns.index("decided")
    rows = sorted(table.rows, key=lambda row: row[at] == "no")[:MOST_COMPARISONS]
    return replace(table, rows=tuple(rows), note=f"{more} more are in the report. {table.note}")


def summary_text(results: Results, written: Written) -> str:
    """Write what the terminal shows: the success table, the headlines, what was left out."""
    parts = [STAND_IN] if results.stand_in else []
    understood = results.provenance.get("read_as")
    if isinstance(understood, list) and understood:
        parts.append("Read:\n" + "\n".join(f"  {line}" for line in understood))
    shown = [t for t in results.tables if t.id in SHOWN or t.id.startswith("end_points_")]
    parts += [as_text(_beginning(table)) for table in shown]
    lines = [f"{label}: {text}" for label, text, _ in headlines(results)]
    if lines or not any(m.value is not None for m in results.measurements):
        parts.append("\n".join(lines) if lines else "Nothing could be measured.")
    if results.exclusions:
        parts.append(
            "Left out:\n"
            + "\n".join(f"  {e.episode} ({e.scope}): {e.reason}" for e in results.exclusions[:12])
        )
        if len(results.exclusions) > 12:
            parts.append(f"  and {len(results.exclusions) - 12} more in the report")
    if results.missing:
        parts.append("Missing:\n" + "\n".join(f"  {text}" for text in results.missing))
    places = f"Report: {written.report}\nNumbers: {written.results}"
    parts.append(places if written.not_written is None else f"{places}\n{written.not_written}")
    return "\n\n".join(parts)
