"""Read a run folder into a ``Comparison``."""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from bridge.episode.catalogue_query import LABEL_SUFFIX
from bridge.episode.provenance import hash_file, software
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.exchange.trials_csv import trials_path
from bridge.task.protocol import VOID_CAUSES, Protocol, read_protocol
from bridge.terminal import Output
from evaluator.cache import SummaryCache
from evaluator.compare.baselines import with_rule
from evaluator.compare.end_points import compare_imported
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.images.methods import compare_renders
from evaluator.compare.images.scores import open_net
from evaluator.compare.images.views import compare_views
from evaluator.compare.measure import Part, joined, refuse_changed
from evaluator.compare.motion import motion_results
from evaluator.compare.notes import check_settings, with_notes
from evaluator.compare.policies import START_LIMIT_M, compare_policies
from evaluator.compare.protocol_check import as_designed, protocol_results
from evaluator.compare.rows import Comparison, TrialRow, stand_in_of
from evaluator.compare.spreadsheet import imported_rows
from evaluator.compare.states import state_results
from evaluator.compare.summaries import Summaries, evaluation_pool, sum_up
from evaluator.compare.trial import Trial, lay_out
from evaluator.metrics.image_options import ImageOptions
from evaluator.result import Exclusion
from evaluator.run_reader.contents import ODD, RunContents, broken, read_contents
from evaluator.run_reader.episodes import DerivedIndex, rollout_of

QUIET = Output(quiet=True)
MADE_FROM = ("source_sha256", "scene_hash", "engine", "seed")
"""What is told of every derived file."""


def compare_run(
    run: RunFolder,
    *,
    images: ImageOptions = ImageOptions(),  # noqa: B008  # frozen
    cache: SummaryCache | None = None,
    output: Output = QUIET,
) -> Comparison:
    """Pair every recorded trial of a run with its replays and measure the agreement.

    A broken episode is left out and named; a missing part is listed, never guessed.
    """
    cache = SummaryCache(None) if cache is None else cache
    read = read_run(RunFolder.open(run.path), cache, output)
    contents = read.contents
    net = open_net(images.lpips_vgg)
    views = compare_views(contents.derived, contents.sources, net=net, cache=cache)
    methods = compare_renders(images, contents.derived, contents.sources, net=net)
    motions = _imported_motions(contents)
    base = compare_read([read], name=read.name, cache=cache)
    # Words of what is missing come first, then those of images and imported motions.
    return replace(
        _with_parts(base, (views, methods, motions)),
        provenance={"folder": str(run.path), **base.provenance, **images.origin()},
    )


@dataclass(frozen=True, kw_only=True)
class ReadRun:
    """Everything of one run that its trials say."""

    run: RunFolder
    contents: RunContents
    trials: list[Trial]
    rows: list[TrialRow]
    summaries: Summaries
    exclusions: tuple[Exclusion, ...]
    unread: tuple[Exclusion, ...]
    """Those of the exclusions that are trials which could not be read."""
    imported: int
    """Trials of the run's own table of trials, and rows that it doubles."""
    protocol: Protocol | None

    @property
    def void_causes(self) -> tuple[str, ...]:
        """Causes that make a trial void, by the run's protocol."""
        return VOID_CAUSES if self.protocol is None else self.protocol.void_causes

    @property
    def name(self) -> str:
        """What the run is called."""
        return self.run.path.resolve().name

    def renamed(self, names: Mapping[str, str]) -> "ReadRun":
        """Return the same with other ids of episodes, which another run has too."""

        def with_new_ids(items: Iterable[Any]) -> Any:
            return tuple(
                replace(item, episode=names[item.episode]) if item.episode in names else item
                for item in items
            )

        parts = {name: with_new_ids(items) for name, items in vars(self.summaries).items()}
        return replace(
            self,
            rows=list(with_new_ids(self.rows)),
            summaries=Summaries(**parts),
            exclusions=with_new_ids(self.exclusions),
        )

    def without(self, episodes: Container[str], reason: str) -> "ReadRun":
        """Return the same without some trials, which are named as left out."""
        there = {row.episode for row in self.rows if row.episode in episodes}
        parts = {
            name: tuple(item for item in items if item.episode not in there)
            for name, items in vars(self.summaries).items()
        }
        gone = [Exclusion(episode=e, scope="everything", reason=reason) for e in sorted(there)]
        return replace(
            self,
            rows=[row for row in self.rows if row.episode not in there],
            summaries=Summaries(**parts),
            exclusions=(*self.exclusions, *gone),
        )


def read_run(run: RunFolder, cache: SummaryCache, output: Output = QUIET) -> ReadRun:
    """Read the trials of a run and sum them up; what cannot be read is left out and named."""
    with evaluation_pool() as pool:
        contents = read_contents(run, cache, output, pool)
        trials, left_out = trials_of(contents)
        summaries = sum_up(trials, cache, output, pool)
    recorded_ids = {recorded.facts.info.id for recorded in contents.recorded}
    imported, doubled = imported_rows(run, recorded_ids)
    protocol = read_protocol(run.path)
    return ReadRun(
        run=run,
        contents=contents,
        trials=trials,
        rows=as_designed(
            [*with_rule((trial.row for trial in trials), summaries.rules), *imported], protocol
        ),
        summaries=summaries,
        exclusions=(*contents.left_out, *left_out, *doubled),
        unread=tuple(left_out),
        imported=len(imported) + len(doubled),
        protocol=protocol,
    )


def compare_read(
    reads: Sequence[ReadRun],
    *,
    name: str,
    more_rows: Sequence[TrialRow] = (),
    cache: SummaryCache | None = None,
) -> Comparison:
    """Measure everything that the trials of some runs say together."""
    rows = [*(row for read in reads for row in read.rows), *more_rows]
    summaries = Summaries(
        **{
            part: tuple(item for read in reads for item in getattr(read.summaries, part))
            for part in Summaries.__dataclass_fields__
        }
    )
    base = compare_rows(
        rows,
        run=name,
        source="run",
        stand_in=stand_in_of(
            [*(row.stand_in for row in more_rows), *(mark for r in reads for mark in _marks(r))]
        ),
        void_causes=tuple(dict.fromkeys(cause for r in reads for cause in r.void_causes)),
        protocol=reads[0].protocol if len(reads) == 1 else None,
        cache=cache,
    )
    trials = [trial for read in reads for trial in read.trials]
    derived = [file for read in reads for file in read.contents.derived]
    missing = [] if rows else ["trials: the run holds no recorded trial"]
    base = replace(
        base,
        tables=with_notes(base.tables, check_settings(trials, derived)),
        exclusions=tuple(
            chain(*(r.exclusions for r in reads), base.exclusions, summaries.left_out)
        ),
        missing=(*missing, *base.missing),
        motions=summaries.motions,
        provenance=provenance_of(reads),
    )
    of_protocol = (
        protocol_results(
            read.rows,
            read.protocol,
            answers=compare_policies(read.rows, read.protocol, read.void_causes),
            left_out=read.unread,
            task_hashes=_task_hashes(read.contents),
        )
        for read in reads
        if len(reads) == 1 and read.protocol is not None
    )
    parts = (motion_results(summaries.motions), state_results(summaries.states), *of_protocol)
    return _with_parts(base, parts)


def _with_parts(base: Comparison, parts: Sequence[Part]) -> Comparison:
    more = vars(joined(parts)).items()
    both: dict[str, Any] = {name: (*getattr(base, name), *items) for name, items in more}
    return replace(base, **both)


def trials_of(contents: RunContents) -> tuple[list[Trial], list[Exclusion]]:
    """Lay every recorded trial beside its replays; one that cannot be judged is left out."""
    refuse_changed(_who_acted(contents))
    index = DerivedIndex(contents.derived)
    trials, left_out = [], []
    for recorded in contents.recorded:
        facts, name = recorded.facts, recorded.facts.info.id
        if facts.info.kind == "trial" and facts.broken:
            left_out.append(Exclusion(episode=name, scope="everything", reason=facts.broken))
        elif facts.info.kind == "trial":
            trial = lay_out(recorded.file, facts, index)
            trials.append(trial)
            left_out += trial.exclusions
    return trials, left_out


def _who_acted(contents: RunContents) -> Iterator[tuple[str, str, str]]:
    """Who acted under which policy's name, in the cell and in the twin."""
    for each in contents.recorded:
        info = each.facts.info
        yield info.id, info.policy, info.checkpoint
    for file in contents.derived:
        told = rollout_of(file)
        if told.get("success") is not None:
            yield file.name, str(told.get("policy", "")), str(told.get("checkpoint", ""))


def _task_hashes(contents: RunContents) -> dict[str, frozenset[str]]:
    infos = [each.facts.info for each in contents.recorded]
    found = {(i.task, i.task_sha256) for i in infos if i.kind == "trial" and i.task_sha256}
    return {task: frozenset(h for name, h in found if name == task) for task, _ in found}


def _imported_motions(contents: RunContents) -> Part:
    imported, left_out = [], []
    for each in contents.recorded:
        if each.facts.info.kind != "imported":
            continue
        try:
            imported.append(Episode.open(each.file.path))
        except ODD as error:  # it was there a moment ago
            left_out.append(broken(each.file.path.name, error, scope="motions"))
    found = compare_imported(imported, [f for f in contents.derived if f.info.kind == "imported"])
    return replace(found, exclusions=(*left_out, *found.exclusions))


def _marks(read: ReadRun) -> Iterator[bool | None]:
    yield from (each.facts.info.stand_in for each in read.contents.recorded)
    yield from (file.info.stand_in for file in read.contents.derived)
    recorded = {each.facts.info.id for each in read.contents.recorded}
    yield from (row.stand_in for row in read.rows if not row.file and row.episode not in recorded)


def provenance_of(reads: Sequence[ReadRun]) -> dict[str, Any]:
    """Say of which bytes numbers are made."""
    parts: dict[str, dict[str, Any]] = {}
    for read in reads:
        labels = sorted(read.run.notes_dir.glob(f"*{LABEL_SUFFIX}"))
        tables = [trials_path(read.run)] if read.imported else []
        parts[str(read.run.path)] = {
            "episodes": {each.file.name: each.file.sha256 for each in read.contents.recorded},
            "derived": {
                file.name: {"sha256": file.sha256}
                | {name: getattr(file.derived, name) for name in MADE_FROM}
                for file in read.contents.derived
            },
            "labels": {path.name: hash_file(path) for path in (*labels, *tables)},
        }
    common: dict[str, Any] = {"software": software(), "start_limit_m": START_LIMIT_M}
    return common | (next(iter(parts.values())) if len(parts) == 1 else {"runs": parts})
