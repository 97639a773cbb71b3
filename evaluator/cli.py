"""Commands of ``evaluator``; imports stay late so that --help is quick."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from bridge.exchange.table_text import AS_SAVED, TableOptions
from bridge.terminal import Output
from evaluator.design.config import StudyOptions, Wanted
from evaluator.errors import EvaluatorError
from evaluator.memory import without_collecting
from evaluator.metrics.image_options import ImageOptions

if TYPE_CHECKING:
    from evaluator.compare import Comparison
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
    from bridge.episode.run_folder import RunFolder
    from evaluator.report.write import summary_text, write_report
    from evaluator.review_index import state_of
    from evaluator.thresholds import missed, parse_thresholds

    thresholds = [] if fail_under is None else parse_thresholds(fail_under)
    with without_collecting():
        published = None
        if check_published is not None:
            from evaluator.compare.published import check_published as recompute

            published = recompute(check_published, tables)
        run = RunFolder(sources[0]) if len(sources) == 1 else None
        state = None if run is None else state_of(run)
        if sources:
            comparison, folder = _compare(sources, tables, images, output)
            comparison = _with_reviews(comparison, sources, reviews, tables)
            if published is not None:
                added = [t for t in published.comparison.tables if t.id == "published"]
                comparison = replace(comparison, tables=(*comparison.tables, *added))
        elif published is not None and check_published is not None:
            comparison = published.comparison
            folder = check_published.with_name(f"{check_published.stem}_results")
        else:
            comparison, folder = _images_alone(images)
        written = write_report(comparison, out or folder, everything=everything, latex=latex)
        results = written.content
        if run and state and written.report.parent == run.results_dir:
            from evaluator.report.review import index_run

            index_run(run, comparison, results, state)
        # Of a large run the record takes a second.
        output.result(results.to_record() if output.json else {}, summary_text(results, written))
        failed = missed(thresholds, results)
        for item in published.failed if published else ():
            where = "" if item.row is None else f"row {item.row}: "
            failed.append(f"{where}{item.what}: {item.verdict}. {item.note}".strip())
        for text in failed:
            output.say(text)
        _refuse_only_broken(results)
    return THRESHOLD_NOT_MET if failed else 0


def _images_alone(images: ImageOptions) -> "tuple[Comparison, Path]":
    from bridge.errors import UsageError
    from evaluator.compare.images.methods import compare_folders

    if not images.renders:
        message = "evaluate needs a run folder or a table, --check-published TABLE, or --reference "
        raise UsageError(message + "FOLDER with --renders METHOD=FOLDER.")
    comparison = compare_folders(images)
    return comparison, Path(f"{comparison.run}_results")


def _compare(
    sources: Sequence[Path], tables: TableOptions, images: ImageOptions, output: Output
) -> "tuple[Comparison, Path]":
    """Return what was found, and the folder for the results where no other is asked for."""
    from bridge.episode.run_folder import RunFolder
    from bridge.errors import UsageError
    from bridge.exchange.trials_csv import trials_path
    from evaluator.cache import FOLDER, SummaryCache
    from evaluator.compare import compare_run
    from evaluator.compare.several import compare_several, is_run

    source = sources[0]
    has_others = source.is_dir() and not is_run(source) and any(source.iterdir())
    if len(sources) > 1 or source.is_file() or has_others:
        if images != IMAGES:
            raise UsageError("images go with one run folder, or with --reference and no table.")
        beside = source.with_name(f"{source.stem}_results") if source.name else Path("results")
        return compare_several(sources, options=tables, output=output), beside
    run = RunFolder.open(source)
    if not trials_path(run).is_file():
        run.refuse_empty()
    with SummaryCache(run.results_dir / FOLDER, say=output.say) as cache:
        return compare_run(run, images=images, cache=cache, output=output), run.results_dir


def _with_reviews(
    comparison: "Comparison", sources: Sequence[Path], reviews: Sequence[Path], tables: TableOptions
) -> "Comparison":
    """Hold the labels against other raters'."""
    from bridge.exchange.reviews import FOLDER, read_reviews
    from evaluator.compare.raters import with_reviews

    kept = [source / FOLDER for source in sources if (source / FOLDER).is_dir()]
    found = [review for path in (*kept, *reviews) for review in read_reviews(path, tables)]
    return with_reviews(comparison, found) if found else comparison


def _refuse_only_broken(results: "Results") -> None:
    """Refuse, after the report, where no episode can be read and nothing else is there."""
    unread = [item.episode for item in results.exclusions if item.scope == "everything"]
    if not unread or any(one.value is not None for one in results.measurements):
        return
    raise EvaluatorError(
        f"nothing could be measured: {', '.join(unread[:3])}{' ...' if len(unread) > 3 else ''} "
        "cannot be read, and there is nothing else. The reasons stand above."
    )


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
