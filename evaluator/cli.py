"""Commands of ``evaluator``; imports stay late so that --help is quick."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from bridge.exchange.table_text import AS_SAVED, TableOptions
from bridge.terminal import Output
from evaluator.design.config import StudyOptions, Wanted
from evaluator.errors import EvaluatorError
from evaluator.memory import without_collecting
from evaluator.metrics.image_options import ImageOptions
from evaluator.review_index import RESULTS

if TYPE_CHECKING:
    from evaluator.compare import Comparison
    from evaluator.compare.published import Finding, PublishedCheck
    from evaluator.result import Results
    from evaluator.thresholds import Missed, Threshold

STUDY, WANTED = StudyOptions(), Wanted()
IMAGES = ImageOptions()
THRESHOLD_NOT_MET = 3


def evaluate(
    *sources: Path,
    out: Path | None = None,
    fail_under: str | float | None = None,
    check_published: Path | None = None,
    against: Path | None = None,
    reviews: tuple[Path, ...] = (),
    interval: Literal["wilson", "clopper-pearson", "jeffreys"] = "wilson",
    everything: Annotated[bool, Parameter(name="--all")] = False,
    latex: bool = False,
    tables: Annotated[TableOptions, Parameter(name="*")] = AS_SAVED,
    images: Annotated[ImageOptions, Parameter(name="*")] = IMAGES,
    output: Output = Output(),  # noqa: B008  # frozen, and cyclopts reads the default
) -> int:
    """Say how far the twin can be trusted: agreement, tables, figures, report.html.

    Example: robot-gst evaluate runs/monday --fail-under r=0.8

    Args:
        sources: A run folder, a table of trials (one row per trial) or of rates (task, condition,
            policy, side, unit, n, rate) in CSV or JSON, or a folder of any of these. Several are
            one study. May be left out with --check-published.
        out: Folder for the results; RUN/results, or NAME_results beside a table, without it.
        fail_under: Exit with 3 when a number stays below: 0.8 for the trials in which sim and
            outcome agree, or r=0.8, ppv=0.9, any id of results.json; several with commas.
        check_published: A published table (a rates CSV with printed figures): recompute it from
            its rows, and exit with 3 when a figure does not follow from them.
        against: A run or table with another twin's answers to the same recorded trials: say how
            much better which one is, which trials flip, and which settings differ.
        reviews: A second rater's labels (columns trial_id, rater, time, result, cause; or a folder
            of such files), beside those in RUN/reviews: kappa of each two raters.
        interval: Interval of success rates.
        everything: Show and write the tables that nobody decides by, and list every number.
        latex: Write the headline tables as LaTeX, too.
        tables: How tables are read.
        images: Renders to compare, and backbones of LPIPS.
    """
    from evaluator.thresholds import parse_thresholds

    thresholds = [] if fail_under is None else parse_thresholds(fail_under)
    asked = _Asked(
        interval=interval,
        tables=tables,
        images=images,
        everything=everything,
        latex=latex,
        check_published=check_published,
        against=against,
        reviews=reviews,
    )
    with without_collecting():
        return _evaluate(sources, asked, out, thresholds, output)


def _evaluate(
    sources: Sequence[Path],
    asked: "_Asked",
    out: Path | None,
    thresholds: "Sequence[Threshold]",
    output: Output,
) -> int:
    """Compare, write and say; return the exit code."""
    from evaluator.report.write import summary_text, write_report
    from evaluator.thresholds import missed

    began_ns = time.time_ns()
    published = _recomputed(asked)
    comparison, folder = _found(sources, asked, published, output)
    written = write_report(
        comparison, out or folder, everything=asked.everything, latex=asked.latex
    )
    results = written.content
    if len(sources) == 1 and written.results == sources[0] / RESULTS:
        from bridge.episode.run_folder import RunFolder
        from evaluator.report.review import index_run

        index_run(RunFolder(sources[0]), comparison, results, began_ns)
    record = results.to_record() if output.json else {}  # of a large run it takes a second
    output.result(record, summary_text(results, written))
    failed = [_missed_text(item) for item in missed(thresholds, results)]
    failed += [_finding_text(item) for item in (published.failed if published else ())]
    for text in failed:
        output.say(text)
    _refuse_only_broken(results)
    return THRESHOLD_NOT_MET if failed else 0


def _recomputed(asked: "_Asked") -> "PublishedCheck | None":
    from evaluator.compare.published import check_published

    table = asked.check_published
    return None if table is None else check_published(table, options=asked.tables)


def _found(
    sources: Sequence[Path], asked: "_Asked", published: "PublishedCheck | None", output: Output
) -> "tuple[Comparison, Path]":
    """Return what was found, and the folder for the results where no other is asked for.

    Raises:
        UsageError: When there is nothing to evaluate.
    """
    if sources:
        comparison, folder = _compare(sources, asked, output)
        comparison = _with_others(comparison, sources, asked, output)
        return (_beside(comparison, published.comparison) if published else comparison), folder
    if published is not None and asked.check_published is not None:
        name = f"{asked.check_published.stem}_results"
        return published.comparison, asked.check_published.with_name(name)
    if asked.images.renders:
        return _compare_images(asked.images)
    from bridge.errors import UsageError

    message = (
        "evaluate needs a run folder or a table, --check-published TABLE, or --reference "
        "FOLDER with --renders METHOD=FOLDER."
    )
    raise UsageError(message)


def _refuse_only_broken(results: "Results") -> None:
    """End with an error, after the report, where no episode can be read and nothing else is there.

    Raises:
        EvaluatorError: Naming them.
    """
    unread = [item.episode for item in results.exclusions if item.scope == "everything"]
    if not unread or any(one.value is not None for one in results.measurements):
        return
    raise EvaluatorError(
        f"nothing could be measured: {', '.join(unread[:3])}{' ...' if len(unread) > 3 else ''} "
        "cannot be read, and there is nothing else. The reasons stand above."
    )


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """What was asked of the sources."""

    interval: str
    tables: TableOptions
    images: ImageOptions
    everything: bool
    latex: bool
    check_published: Path | None
    against: Path | None
    reviews: Sequence[Path]


def design(
    run: Path,
    /,
    *,
    study: Annotated[StudyOptions, Parameter(name="*")] = STUDY,
    wanted: Annotated[Wanted, Parameter(name="*")] = WANTED,
    output: Output = Output(),  # noqa: B008  # frozen, and cyclopts reads the default
) -> None:
    """Size a study before its first trial, and lock its protocol: protocol.json, order.csv.

    Example: robot-gst design runs/study --rate 0.5 --gain 0.3 --width 0.4

    Args:
        run: Folder of the study; made where it is not there.
        study: What is tried.
        wanted: What is expected, and what is to be shown.
    """
    from evaluator.design.plan import design as make
    from evaluator.design.plan import design_record, design_text, lock

    made = make(study, wanted)
    written = lock(run, made)
    output.result(design_record(made, written), design_text(made, written, run, study))


def _compare(sources: Sequence[Path], asked: _Asked, output: Output) -> "tuple[Comparison, Path]":
    from bridge.episode.run_folder import RunFolder
    from bridge.errors import UsageError
    from bridge.exchange.trials_csv import trials_path
    from evaluator.cache import FOLDER, SummaryCache
    from evaluator.compare import compare_run

    source = sources[0]
    beside = source.with_name(f"{source.stem}_results") if source.name else Path("results")
    is_run = any((source / name).is_dir() for name in ("episodes", "derived", "scene", "notes"))
    is_results = source.is_file() or (source.is_dir() and not is_run and any(source.iterdir()))
    if len(sources) > 1 or is_results:
        if asked.images != IMAGES:
            message = "images go with one run folder, or with --reference and no table."
            raise UsageError(message)
        if source.is_file() and len(sources) == 1:
            return _compare_table(source, asked), beside
        return _compare_several(sources, asked, output), beside
    run = RunFolder.open(source)
    if not trials_path(run).is_file():
        run.refuse_empty()
    with SummaryCache(run.results_dir / FOLDER, say=output.say) as cache:
        comparison = compare_run(
            run,
            method=asked.interval,
            images=asked.images,
            cache=cache,
            output=output,
        )
    return comparison, run.results_dir


def _with_others(
    comparison: "Comparison", sources: Sequence[Path], asked: _Asked, output: Output
) -> "Comparison":
    """Hold the results against another twin's, and against other raters' labels."""
    from bridge.exchange.reviews import FOLDER, read_reviews
    from evaluator.compare.raters import with_reviews
    from evaluator.compare.several import with_against

    tables = asked.tables
    if asked.against is not None:
        comparison = with_against(
            comparison, sources[0], asked.against, options=tables, output=output
        )
    kept = [source / FOLDER for source in sources if (source / FOLDER).is_dir()]
    found = [review for path in (*kept, *asked.reviews) for review in read_reviews(path, tables)]
    return with_reviews(comparison, found) if found else comparison


def _compare_table(source: Path, asked: _Asked) -> "Comparison":
    from evaluator.compare import compare_csv

    return compare_csv(source, method=asked.interval, options=asked.tables)


def _compare_several(sources: Sequence[Path], asked: _Asked, output: Output) -> "Comparison":
    from evaluator.compare.several import compare_several

    return compare_several(
        sources,
        method=asked.interval,
        options=asked.tables,
        output=output,
    )


def _compare_images(images: ImageOptions) -> "tuple[Comparison, Path]":
    """Compare renders with a folder of recorded images, without any run."""
    from evaluator.compare.images.methods import compare_folders

    comparison = compare_folders(images)
    return comparison, Path(f"{comparison.run}_results")


def _beside(comparison: "Comparison", published: "Comparison") -> "Comparison":
    """Add the check of a published table to a report about something else."""
    from dataclasses import replace

    added = [table for table in published.tables if table.id == "published"]
    return replace(comparison, tables=(*comparison.tables, *added))


def _missed_text(item: "Missed") -> str:
    threshold = item.threshold
    name = "Agreement of sim and outcome" if threshold.name == "agreement" else threshold.name
    shown = item.reason if item.value is None else f"{item.value:.4g}"
    return f"{name} is {shown}; the threshold is {threshold.limit:g}."


def _finding_text(item: "Finding") -> str:
    where = "" if item.row is None else f"row {item.row}: "
    return f"{where}{item.what}: {item.verdict}. {item.note}".strip()
