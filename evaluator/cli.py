"""Commands of ``evaluator``; imports stay late so that --help is quick."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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

STUDY, WANTED = StudyOptions(), Wanted()
IMAGES = ImageOptions()
THRESHOLD_NOT_MET = 3


def evaluate(
    *sources: Path,
    out: Path | None = None,
    fail_under: str | float | None = None,
    check_published: Path | None = None,
    reviews: tuple[Path, ...] = (),
    everything: Annotated[bool, Parameter(name="--all")] = False,
    latex: bool = False,
    tables: Annotated[TableOptions, Parameter(name="*")] = AS_SAVED,
    images: Annotated[ImageOptions, Parameter(name="*")] = IMAGES,
    output: Output = Output(),  # noqa: B008  # frozen, and cyclopts reads the default
) -> int:
    """Say how far the twin can be trusted: agreement, tables, figures, report.html.

    Example: robot-gst evaluate runs/monday --fail-under r=0.8

    Args:
        sources: A run folder, or a table of trials (one row per trial) or of rates (policy, real,
            sim). Several are one study. May be left out with --check-published.
        out: Folder for the results; RUN/results, or NAME_results beside a table, without it.
        fail_under: Exit with 3 when a number stays below: 0.8 for the trials in which sim and
            outcome agree, or r=0.8, ppv=0.9, any id of results.json; several with commas.
        check_published: A published table (a rates CSV with printed figures): recompute it from
            its rows, and exit with 3 when a figure does not follow from them.
        reviews: A second rater's labels (columns trial_id, rater, time, result, cause; or a folder
            of such files), beside those in RUN/reviews: kappa of each two raters.
        everything: Show and write the tables that nobody decides by, and list every number.
        latex: Write the headline tables as LaTeX, too.
        tables: How tables are read.
        images: Renders to compare, and backbones of LPIPS.
    """
    from evaluator.report.write import summary_text, write_report
    from evaluator.thresholds import missed, parse_thresholds

    thresholds = [] if fail_under is None else parse_thresholds(fail_under)
    asked = _Asked(
        sources=sources,
        tables=tables,
        images=images,
        check_published=check_published,
        reviews=reviews,
        output=output,
    )
    with without_collecting():
        published = _recomputed(asked)
        began_ns = time.time_ns()
        comparison, folder = _found(asked, published)
        written = write_report(comparison, out or folder, everything=everything, latex=latex)
        results = written.content
        if len(sources) == 1 and written.results == sources[0] / RESULTS:
            from bridge.episode.run_folder import RunFolder
            from evaluator.report.review import index_run

            index_run(RunFolder(sources[0]), comparison, results, began_ns)
        record = results.to_record() if output.json else {}  # of a large run it takes a second
        output.result(record, summary_text(results, written))
        failed = missed(thresholds, results)
        failed += [_finding_text(item) for item in (published.failed if published else ())]
        for text in failed:
            output.say(text)
        _refuse_only_broken(results)
    return THRESHOLD_NOT_MET if failed else 0


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """What was asked."""

    sources: Sequence[Path]
    tables: TableOptions
    images: ImageOptions
    check_published: Path | None
    reviews: Sequence[Path]
    output: Output


def _recomputed(asked: _Asked) -> "PublishedCheck | None":
    from evaluator.compare.published import check_published

    table = asked.check_published
    return None if table is None else check_published(table, asked.tables)


def _found(asked: _Asked, published: "PublishedCheck | None") -> "tuple[Comparison, Path]":
    """Return what was found, and the folder for the results where no other is asked for.

    Raises:
        UsageError: When there is nothing to evaluate.
    """
    from bridge.errors import UsageError
    from evaluator.compare.images.methods import compare_folders

    if asked.sources:
        comparison, folder = _compare(asked)
        comparison = _with_others(comparison, asked)
        if published is not None:
            added = [table for table in published.comparison.tables if table.id == "published"]
            comparison = replace(comparison, tables=(*comparison.tables, *added))
        return comparison, folder
    if published is not None and asked.check_published is not None:
        name = f"{asked.check_published.stem}_results"
        return published.comparison, asked.check_published.with_name(name)
    if asked.images.renders:
        comparison = compare_folders(asked.images)
        return comparison, Path(f"{comparison.run}_results")
    raise UsageError(
        "evaluate needs a run folder or a table, --check-published TABLE, or --reference "
        "FOLDER with --renders METHOD=FOLDER."
    )


def _compare(asked: _Asked) -> "tuple[Comparison, Path]":
    from bridge.episode.run_folder import RunFolder
    from bridge.errors import UsageError
    from bridge.exchange.trials_csv import trials_path
    from evaluator.cache import FOLDER, SummaryCache
    from evaluator.compare import compare_run
    from evaluator.compare.several import compare_several, is_run

    source, output = asked.sources[0], asked.output
    has_others = source.is_dir() and not is_run(source) and any(source.iterdir())
    if len(asked.sources) > 1 or source.is_file() or has_others:
        if asked.images != IMAGES:
            message = "images go with one run folder, or with --reference and no table."
            raise UsageError(message)
        beside = source.with_name(f"{source.stem}_results") if source.name else Path("results")
        return compare_several(asked.sources, options=asked.tables, output=output), beside
    run = RunFolder.open(source)
    if not trials_path(run).is_file():
        run.refuse_empty()
    with SummaryCache(run.results_dir / FOLDER, say=output.say) as cache:
        return compare_run(run, images=asked.images, cache=cache, output=output), run.results_dir


def _with_others(comparison: "Comparison", asked: _Asked) -> "Comparison":
    """Hold the labels against other raters'."""
    from bridge.exchange.reviews import FOLDER, read_reviews
    from evaluator.compare.raters import with_reviews

    kept = [source / FOLDER for source in asked.sources if (source / FOLDER).is_dir()]
    paths = (*kept, *asked.reviews)
    found = [review for path in paths for review in read_reviews(path, asked.tables)]
    return with_reviews(comparison, found) if found else comparison


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


def _finding_text(item: "Finding") -> str:
    where = "" if item.row is None else f"row {item.row}: "
    return f"{where}{item.what}: {item.verdict}. {item.note}".strip()


def design(
    run: Path,
    /,
    *,
    study: Annotated[StudyOptions, Parameter(name="*")] = STUDY,
    wanted: Annotated[Wanted, Parameter(name="*")] = WANTED,
    output: Output = Output(),  # noqa: B008  # frozen, and cyclopts reads the default
) -> None:
    """Size a study before its first trial, and lock its protocol: protocol.json, order.csv.

    Example: robot-gst design runs/study --rate 0.5 --gain 0.3

    Args:
        run: Folder of the study; made where it is not there.
        study: What is tried.
        wanted: What is expected, and what is to be shown.
    """
    from evaluator.design.plan import design as make
    from evaluator.design.plan import design_record, design_text, lock

    made = make(study, wanted)
    written = lock(run, made)
    output.result(design_record(made, written), design_text(made, written, run))
