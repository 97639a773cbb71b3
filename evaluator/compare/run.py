"""Read a run folder into a ``Comparison``."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from bridge.episode.provenance import hash_file, software
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.exchange.trials_csv import trials_path
from bridge.task.protocol import VOID_CAUSES, read_protocol
from bridge.terminal import Output
from evaluator.cache import SummaryCache
from evaluator.compare.bands import BandReport, compare_bands
from evaluator.compare.baselines import with_rule
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.gains import START_LIMIT_M
from evaluator.compare.images.renders import compare_renders
from evaluator.compare.images.scores import open_nets
from evaluator.compare.images.views import ViewReport, compare_views
from evaluator.compare.labels import label_results
from evaluator.compare.measure import Part
from evaluator.compare.motion import motion_results
from evaluator.compare.notes import check_settings, with_notes
from evaluator.compare.protocol_check import as_designed, protocol_results
from evaluator.compare.rows import Comparison, TrialRow, stand_in_of
from evaluator.compare.spreadsheet import imported_rows
from evaluator.compare.states import state_results
from evaluator.compare.summaries import evaluation_pool, sum_up
from evaluator.compare.trial import Trial, lay_out
from evaluator.metrics.image_protocol import ImageOptions
from evaluator.result import Exclusion
from evaluator.run_reader.contents import ODD, RunContents, broken, read_contents
from evaluator.run_reader.episodes import DerivedIndex

Item = TypeVar("Item")
AnyPart = Part | ViewReport | BandReport

QUIET = Output(quiet=True)


def compare_run(
    run: RunFolder,
    *,
    method: str = "wilson",
    goal: float | None = None,
    images: ImageOptions = ImageOptions(),  # noqa: B008  # frozen
    cache: SummaryCache | None = None,
    output: Output = QUIET,
) -> Comparison:
    """Pair every recorded trial of a run with its replays and measure the agreement.

    A broken episode is left out and named; a missing part is listed, never guessed.

    Args:
        run: The run folder.
        method: Interval of rates: wilson, clopper-pearson or jeffreys.
        goal: Success rate to stop or continue for.
        images: Backbones of LPIPS, and other methods to compare with the views of the run.
        cache: What earlier evaluations read; without one every file is read.
        output: Shows progress.

    Raises:
        PathNotFoundError: When the run folder is not there.
    """
    run = RunFolder.open(run.path)
    cache = SummaryCache(None) if cache is None else cache
    with evaluation_pool() as pool:
        contents = read_contents(run, cache, output, pool)
        trials, left_out = trials_of(contents)
        summaries = sum_up(trials, cache, output, pool)
    recorded_ids = {recorded.facts.info.id for recorded in contents.recorded}
    imported, doubled = imported_rows(run, recorded_ids)
    protocol = read_protocol(run.path)
    all_rows = [*with_rule((trial.row for trial in trials), summaries.rules), *imported]
    rows = as_designed(all_rows, protocol)
    nets = open_nets(images.backbones)
    views = compare_views(contents.derived, contents.sources, nets=nets, cache=cache)
    methods = compare_renders(images, contents.derived, contents.sources, nets=nets)
    bands = _bands(contents)
    parts = (
        motion_results(summaries.motions),
        state_results(summaries.states),
        label_results(summaries.perceived, rows, method=method),
        views,
        methods,
        bands,
        protocol_results(
            rows,
            protocol,
            method=method,
            left_out=left_out,
            task_hashes=_task_hashes(contents),
        ),
    )
    base = compare_rows(
        rows,
        run=run.path.resolve().name,
        source="run",
        stand_in=_stand_in(contents, imported),
        method=method,
        goal=goal,
        void_causes=VOID_CAUSES if protocol is None else protocol.void_causes,
    )
    base = replace(
        base,
        tables=with_notes(base.tables, check_settings(trials, contents.derived)),
    )
    missing = [] if rows else ["trials: the run holds no recorded trial"]
    base = replace(
        base,
        exclusions=(*contents.left_out, *left_out, *doubled, *base.exclusions, *summaries.left_out),
        missing=(*missing, *base.missing),
    )
    return replace(
        _with_parts(base, parts),
        motions=summaries.motions,
        states=summaries.states,
        bands=bands.curves,
        views=(*views.views, *methods.views),
        provenance=_provenance(
            contents, hash_file(trials_path(run)) if imported or doubled else None
        ),
    )


def _with_parts(base: Comparison, parts: Sequence[AnyPart]) -> Comparison:
    return replace(
        base,
        measurements=_joined(base.measurements, (part.measurements for part in parts)),
        tables=_joined(base.tables, (part.tables for part in parts)),
        exclusions=_joined(base.exclusions, (part.exclusions for part in parts)),
        missing=_joined(base.missing, (part.missing for part in parts)),
    )


def _joined(first: Iterable[Item], others: Iterable[Iterable[Item]]) -> tuple[Item, ...]:
    return (*first, *(item for other in others for item in other))


def trials_of(contents: RunContents) -> tuple[list[Trial], list[Exclusion]]:
    """Lay every recorded trial beside its replays; one that cannot be judged is left out."""
    index = DerivedIndex(contents.derived)
    trials, left_out = [], []
    for recorded in contents.recorded:
        facts = recorded.facts
        if facts.info.kind != "trial":
            continue
        if facts.broken:
            left_out.append(
                Exclusion(episode=facts.info.id, scope="everything", reason=facts.broken)
            )
            continue
        trial = lay_out(recorded.file, facts, index)
        trials.append(trial)
        left_out += trial.exclusions
    return trials, left_out


def _task_hashes(contents: RunContents) -> dict[str, frozenset[str]]:
    found: dict[str, set[str]] = {}
    for each in contents.recorded:
        info = each.facts.info
        if info.kind == "trial" and info.task_sha256:
            found.setdefault(info.task, set()).add(info.task_sha256)
    return {task: frozenset(hashes) for task, hashes in found.items()}


def _bands(contents: RunContents) -> BandReport:
    imported, left_out = [], []
    for each in contents.recorded:
        if each.facts.info.kind != "imported":
            continue
        try:
            imported.append(Episode.open(each.file.path))
        except ODD as error:  # it was there a moment ago
            left_out.append(broken(each.file.path.name, error, scope="bands"))
    report = compare_bands(imported, [f for f in contents.derived if f.info.kind == "imported"])
    return replace(report, exclusions=(*left_out, *report.exclusions))


def _stand_in(contents: RunContents, imported: Sequence[TrialRow]) -> bool | None:
    marks: list[bool | None] = [each.facts.info.stand_in for each in contents.recorded]
    marks += [file.info.stand_in for file in contents.derived]
    marks += [row.stand_in for row in imported]
    return stand_in_of(marks)


def _provenance(contents: RunContents, imported_sha256: str | None) -> dict[str, Any]:
    return {
        "software": software(),
        "start_limit_m": START_LIMIT_M,
        "imported_trials": imported_sha256,
        "episodes": {each.file.name: each.file.sha256 for each in contents.recorded},
        "derived": {
            file.name: {
                "sha256": file.sha256,
                "source_sha256": file.derived.source_sha256,
                "scene_hash": file.derived.scene_hash,
                "engine": file.derived.engine,
                "seed": file.derived.seed,
            }
            for file in contents.derived
        },
    }
