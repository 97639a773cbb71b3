"""Put one comparison on disk: results.json, tables, figures, report.html, trials.csv, Parquet."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.exchange.trials_csv import TrialRecord, write_trials
from evaluator.compare.rows import Comparison
from evaluator.compare.spreadsheet import record_from_row
from evaluator.errors import EvaluatorError
from evaluator.report.figures import scatter_svg, success_svg
from evaluator.report.page import page
from evaluator.report.tables import as_csv, as_latex, as_markdown, as_text
from evaluator.report.wording import headlines, stand_in_sentence
from evaluator.result import Results, write_results

SHOWN = ("published", "success", "layout", "gains", "stopping", "remarks")
"""Tables a terminal shows; the others are in the report."""

PARQUET_PACKAGES = ("pandas", "pyarrow")


@dataclass(frozen=True, kw_only=True)
class Written:
    """Where everything lies."""

    results: Path
    report: Path
    files: tuple[Path, ...]
    not_written: str | None = None
    """Why there is no Parquet beside the CSV, or None."""


def write_report(comparison: Comparison, folder: Path) -> Written:
    """Write every file of one evaluation into ``folder``, replacing an earlier one.

    Raises:
        EvaluatorError: When the folder cannot be written.
    """
    results = comparison.results()
    path = write_results(results, folder / "results.json")
    word = comparison.recorded_word
    drawn = {
        "scatter": scatter_svg(comparison.cells, word),
        "success": success_svg(comparison.cells, word),
    }
    figures = {name: svg for name, svg in drawn.items() if svg is not None}
    texts = {folder / "report.html": page(results, list(figures.values()))}
    texts |= {folder / "figures" / f"{name}.svg": svg for name, svg in figures.items()}
    for table in results.tables:
        for suffix, write in (("csv", as_csv), ("md", as_markdown), ("tex", as_latex)):
            texts[folder / "tables" / f"{table.id}.{suffix}"] = write(table)
    try:
        for place, text in texts.items():
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(text, encoding="utf-8")
        trials = [record_from_row(row) for row in comparison.rows]
        extra = [write_trials(folder / "trials.csv", trials)] if trials else []
        parquet, reason = _write_parquet(folder, trials, results)
    except OSError as error:
        message = f"cannot write into {folder}: {error.strerror}. Choose another with --out."
        raise EvaluatorError(message) from error
    return Written(
        results=path,
        report=folder / "report.html",
        files=(*texts, *extra, *parquet),
        not_written=reason,
    )


def _write_parquet(
    folder: Path, trials: Sequence[TrialRecord], results: Results
) -> tuple[list[Path], str | None]:
    """Write the Parquet files, or say why not; pandas is heavy and may be missing."""
    try:
        from evaluator.report import parquet  # noqa: PLC0415  # loads pandas only when writing
    except ModuleNotFoundError as error:
        if error.name not in PARQUET_PACKAGES:
            raise
        reason = (
            f"trials.parquet, measurements.parquet not written: {error.name} is not installed "
            "(pip install 'robot-gst[report]')"
        )
        return [], reason
    written = [parquet.write_measurements(folder / "measurements.parquet", results.measurements)]
    if trials:
        written.append(parquet.write_trials(folder / "trials.parquet", trials))
    return written, None


def summary_text(results: Results, written: Written) -> str:
    """Write what the terminal shows: the success table, the headlines, what was left out."""
    parts = []
    banner = stand_in_sentence(results)
    if banner:
        parts.append(banner)
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
