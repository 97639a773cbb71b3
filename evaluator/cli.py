"""Commands of the room ``evaluator``; imports stay late so that --help is quick."""

from pathlib import Path
from typing import TYPE_CHECKING

from bridge.terminal import Output

if TYPE_CHECKING:
    from evaluator.result import Results

THRESHOLD_NOT_MET = 3


def evaluate(
    source: Path,
    /,
    *,
    out: Path | None = None,
    fail_under: float | None = None,
    output: Output = Output(),  # noqa: B008  # frozen, and cyclopts reads the default
) -> int:
    """Say how far the twin can be trusted: agreement, tables, figures, report.html.

    Example: robot-gst evaluate runs/monday --fail-under 0.8

    Args:
        source: A run folder, a trials CSV (one row per trial) or a rates CSV (task, condition,
            side, unit, n, rate).
        out: Folder for the results; RUN/results, or NAME_results beside a CSV NAME.csv, without it.
        fail_under: Exit with 3 when sim and outcome agree in a smaller fraction of trials (0..1).
        output: How to talk.
    """
    from bridge.episode.run import RunFolder
    from bridge.errors import UsageError
    from evaluator.compare import compare_csv, compare_run
    from evaluator.report.write import summary_text, write_report

    if fail_under is not None and not 0 <= fail_under <= 1:
        message = f"--fail-under {fail_under} is not a fraction from 0 to 1, for example 0.8."
        raise UsageError(message)
    if source.suffix.lower() == ".csv" and not source.is_dir():
        comparison = compare_csv(source)
        folder = out or source.with_name(f"{source.stem}_results")
    else:
        run = RunFolder.open(source)
        comparison = compare_run(run)
        folder = out or run.results_dir
    written = write_report(comparison, folder)
    results = comparison.results()
    output.result(results.to_record(), summary_text(results, written))
    if fail_under is None:
        return 0
    return _judge(results, fail_under, output)


def _judge(results: "Results", fail_under: float, output: Output) -> int:
    from evaluator.report.wording import measurement_text

    found = [m for m in results.measurements if m.id == "agreement.sim_planned.rate"]
    if found and found[0].value is not None and found[0].value >= fail_under:
        return 0
    shown = measurement_text(found[0]) if found else "undefined: no trials to compare"
    output.say(f"Agreement of sim and outcome is {shown}; the threshold is {fail_under:g}.")
    return THRESHOLD_NOT_MET
