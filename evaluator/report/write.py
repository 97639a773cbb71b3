"""Put one comparison on disk: results.json, tables, figures, report.html, trials.csv, Parquet."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bridge.exchange.trials_csv import TrialRecord, write_trials
from evaluator.compare.rows import Comparison
from evaluator.compare.spreadsheet import record_from_row
from evaluator.errors import EvaluatorError
from evaluator.report.figures.beside import Beside
from evaluator.report.figures.distributions import worst_pairs
from evaluator.report.figures.drawing import Drawing, NotDrawn, Rendered
from evaluator.report.figures.selection import drawable, drawings_of
from evaluator.report.methods import methods
from evaluator.report.page import name_shared, page
from evaluator.report.sections import TRIALS
from evaluator.report.tables import as_csv, as_latex, as_markdown, as_text, latex
from evaluator.report.wording import headlines, stand_in_sentence
from evaluator.result import Results, write_results

SHOWN = (
    "intake",
    "published",
    "success",
    "layout",
    "study_arms",
    "study_gains",
    "gains",
    "retries",
    "image_methods",
    "stopping",
    "notes",
)
"""Tables a terminal shows; the others are in the report."""

GROUPS = "success"
"""The table of success rates; ``groups.parquet`` holds it too."""

PARQUET_PACKAGES = ("pyarrow",)
FIGURE_PACKAGES = ("matplotlib",)
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


def write_report(comparison: Comparison, folder: Path, beside: Beside | None = None) -> Written:
    """Write every file of one evaluation into ``folder``, replacing an earlier one.

    Args:
        comparison: What to report.
        folder: Where to.
        beside: Draws the figures meanwhile; they are the same without it.

    Raises:
        EvaluatorError: When the folder cannot be written.
    """
    shown = drawable(comparison)
    if beside is not None:
        beside.send(shown)
    drawn, not_drawn = drawings_of(shown)
    results = comparison.results()
    if not_drawn:
        words = "; ".join(f"{item.id} ({item.reason})" for item in not_drawn)
        missing = f"figures without data, not drawn: {words}"
        results = replace(results, missing=(*results.missing, missing))
    old = _old_files(folder, results)
    path = write_results(results, folder / "results.json")
    try:
        paper = dict(zip(("methods.tex", "references.bib"), methods(results), strict=True))
        texts = {folder / "tables" / name: text.encode() for name, text in paper.items()}
        tables = _write(_table_files(folder / "tables", results) | texts)
        _remove_old(folder, not_drawn, old)
        trials = [record_from_row(row) for row in comparison.rows]
        extra = [write_trials(folder / "trials.csv", trials)] if trials else []
        parquet, no_parquet = _write_parquet(folder, trials, results)
        rendered, no_figures = _render(drawn, beside)
        inline = {item.drawing.id: item.inline for item in rendered}
        text = page(
            results,
            [(drawing, inline.get(drawing.id)) for drawing in drawn],
            worst_pairs(comparison.views),
        )
        report = {folder / "report.html": text.encode()}
        shown_files = _write(report | _figure_files(folder / "figures", drawn, rendered))
        name_shared(folder / "report.html")
    except OSError as error:
        message = f"cannot write into {folder}: {error.strerror}. Choose another with --out."
        raise EvaluatorError(message) from error
    return Written(
        content=results,
        results=path,
        report=folder / "report.html",
        files=(*shown_files, *tables, *extra, *parquet),
        not_written="; ".join(filter(None, (no_figures, no_parquet))) or None,
    )


def _render(
    drawn: Sequence[Drawing], beside: Beside | None
) -> tuple[Sequence[Rendered], str | None]:
    """Draw the figures, or say why not; matplotlib is heavy and may be missing."""
    if not drawn:
        return [], None
    found = None if beside is None else beside.take(drawn)
    if found is not None:
        return found, None
    try:
        from evaluator.report.figures import render  # noqa: PLC0415  # loads matplotlib
    except ModuleNotFoundError as error:
        if error.name not in FIGURE_PACKAGES:
            raise
        return [], f"figures not drawn: {error.name} is not installed ({INSTALL})"
    return [render.render(drawing) for drawing in drawn], None


def _write(contents: Mapping[Path, bytes]) -> list[Path]:
    for place, data in contents.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(data)
    return list(contents)


def _table_files(folder: Path, results: Results) -> dict[Path, bytes]:
    return {
        folder / f"{table.id}.{suffix}": write(table).encode()
        for table in results.tables
        for suffix, write in (("csv", as_csv), ("md", as_markdown), ("tex", as_latex))
    }


def _figure_files(
    folder: Path, drawn: Sequence[Drawing], rendered: Sequence[Rendered]
) -> dict[Path, bytes]:
    files = {folder / f"{drawing.id}.csv": as_csv(drawing.table).encode() for drawing in drawn}
    for item in rendered:
        files[folder / f"{item.drawing.id}.svg"] = item.svg
        files[folder / f"{item.drawing.id}.pdf"] = item.pdf
        files[folder / f"{item.drawing.id}.tex"] = figure_latex(item.drawing).encode()
    return files


def figure_latex(drawing: Drawing) -> str:
    r"""Write a figure for a paper: as wide as it was drawn, or as the column where that is less.

    The document needs ``\usepackage{graphicx}`` and the folder ``figures`` beside it.
    """
    width = f"{drawing.width_in:g}in"
    lines = (
        r"\begin{figure}[t]",
        r"\centering",
        rf"\includegraphics[width=\ifdim\linewidth<{width}\linewidth\else{width}\fi]"
        rf"{{figures/{drawing.id}.pdf}}",
        rf"\caption{{{latex(f'{drawing.title}. {drawing.caption}')}}}",
        rf"\label{{fig:{drawing.id}}}",
        r"\end{figure}",
    )
    return "\n".join(lines) + "\n"


def _old_files(folder: Path, results: Results) -> list[Path]:
    """List what the earlier evaluation wrote and this one will not; only what it says is its own.

    A paper that includes a table would else go on to print the numbers of another evaluation.
    """
    now = {table.id for table in results.tables} | {"methods", "references"}
    try:
        named = {path.stem for path in (folder / "tables").iterdir()} - now
        if not named:
            return []
        tables = json.loads((folder / "results.json").read_bytes())["tables"]
        gone = sorted(named & {str(table["id"]) for table in tables})
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []  # nothing of ours
    files = [folder / "tables" / f"{name}.{end}" for name in gone for end in ("csv", "md", "tex")]
    if TRIALS in gone:
        files += [folder / "trials.csv", folder / "trials.parquet"]
    if GROUPS in gone:
        files.append(folder / "groups.parquet")
    return files


def _remove_old(folder: Path, not_drawn: Sequence[NotDrawn], old: Sequence[Path]) -> None:
    """Remove what an earlier evaluation wrote and this one has no data for."""
    for path in old:
        path.unlink(missing_ok=True)
    for item in not_drawn:
        for ending in ("csv", "svg", "pdf", "tex"):
            (folder / "figures" / f"{item.id}.{ending}").unlink(missing_ok=True)


def _write_parquet(
    folder: Path, trials: Sequence[TrialRecord], results: Results
) -> tuple[list[Path], str | None]:
    """Write the Parquet files, or say why not; pyarrow is heavy and may be missing."""
    try:
        from evaluator.report import parquet  # noqa: PLC0415  # loads pyarrow only when writing
    except ModuleNotFoundError as error:
        if error.name not in PARQUET_PACKAGES:
            raise
        reason = (
            f"trials, groups and measurements.parquet not written: {error.name} is not installed "
            f"({INSTALL})"
        )
        return [], reason
    written = [parquet.write_measurements(folder / "measurements.parquet", results.measurements)]
    groups = next((table for table in results.tables if table.id == GROUPS), None)
    if groups is not None:
        written.append(parquet.write_table(folder / "groups.parquet", groups))
    if trials:
        written.append(parquet.write_trials(folder / "trials.parquet", trials))
    return written, None


def summary_text(results: Results, written: Written) -> str:
    """Write what the terminal shows: the success table, the headlines, what was left out."""
    parts = []
    banner = stand_in_sentence(results)
    if banner:
        parts.append(banner)
    understood = results.provenance.get("read_as")
    if isinstance(understood, list) and understood:
        parts.append("Read:\n" + "\n".join(f"  {line}" for line in understood))
    shown = [t for t in results.tables if t.id in SHOWN or t.id.startswith("bands_")]
    parts += [as_text(table) for table in shown]
    lines = [f"{label}: {text}" for label, text, _ in headlines(results)]
    if lines or not results.measurements:
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
