"""Runs and tables in one evaluation, one or several: groups over all of them."""

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange.table_text import AS_SAVED, TableOptions
from bridge.exchange.trials_rates import RateRecord
from bridge.terminal import Output
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.intake import PUBLISHED, Taken, take
from evaluator.compare.measure import refuse_alike
from evaluator.compare.published import check_published
from evaluator.compare.rates import compare_records
from evaluator.compare.rows import Comparison, TrialRow, stand_in_of
from evaluator.compare.run import QUIET, ReadRun, compare_read, read_run
from evaluator.compare.spreadsheet import row_from_record, unknown_sides
from evaluator.quantity import slug

ALONE = "of several runs together; evaluate each run alone for it"


@dataclass(kw_only=True)
class _Gathered:
    """What the sources hold, before it is measured."""

    name: str
    reads: list[ReadRun] = field(default_factory=list)
    taken: list[Taken] = field(default_factory=list)

    def rows(self) -> list[TrialRow]:
        """Trials of tables; an id that another table has too is told apart by the file's name."""
        by_file = [(each, list(map(row_from_record, each.trials))) for each in self.taken]
        counts = Counter(row.episode for _, rows in by_file for row in rows)
        counts.update(row.episode for read in self.reads for row in read.rows)
        return [
            replace(row, episode=f"{each.path.stem}/{row.episode}")
            if counts[row.episode] > 1
            else row
            for each, rows in by_file
            for row in rows
        ]


def compare_csv(path: Path, options: TableOptions = AS_SAVED) -> Comparison:
    """Compare one table: trials, rates, or rates with printed figures; its content tells which."""
    return compare_several([path], options=options)


def compare_several(
    sources: Sequence[Path], *, options: TableOptions = AS_SAVED, output: Output = QUIET
) -> Comparison:
    """Compare runs and tables as one study.

    Groups are task x condition x policy over all of them. An episode or trial id that two sources
    have is told apart by the source's name; an episode that is there twice counts once. Starts of
    one id are one start, wherever they were tried.
    """
    refuse_twice(sources)
    with ExitStack() as caches:
        gathered = _gather(sources, options, output, caches)
    if any(each.kind == PUBLISHED for each in gathered.taken):
        if len(sources) > 1:
            raise UsageError("a table of printed figures is checked alone: --check-published.")
        return check_published(sources[0], options).comparison
    with_rates = [each for each in gathered.taken if each.rates]
    if with_rates and (len(with_rates) < len(gathered.taken) or gathered.reads):
        raise UsageError(
            f"{with_rates[0].path} holds rates, and other sources hold trials: rates that rest on "
            "them would count twice. Evaluate it alone."
        )
    return _rates(gathered) if with_rates else _trials(gathered)


def is_run(path: Path) -> bool:
    """Say whether a folder is one of a run."""
    return any((path / name).is_dir() for name in ("episodes", "derived", "scene", "notes"))


def refuse_twice(sources: Sequence[Path]) -> None:
    """Refuse a source that is given twice: its trials would count double."""
    seen: dict[str, Path] = {}
    for source in sources:
        same = hash_file(source) if source.is_file() else str(source.resolve())
        if same in seen:
            like = "" if seen[same] == source else f", once as {seen[same]}"
            raise UsageError(f"{source} is given twice{like}; its trials would count double.")
        seen[same] = source


def _gather(
    sources: Sequence[Path], options: TableOptions, output: Output, caches: ExitStack
) -> _Gathered:
    alone = len(sources) == 1 and sources[0].is_file()
    name = sources[0].stem if alone else " + ".join(source.resolve().name for source in sources)
    gathered = _Gathered(name=name)
    for source in sources:
        if is_run(source):
            run = RunFolder.open(source)
            cache = SummaryCache(run.results_dir / FOLDER, say=output.say)
            read = read_run(run, caches.enter_context(cache), output)
            gathered.reads.append(_with_own_ids(read, gathered.reads))
        elif source.is_dir():
            message = f"{source} holds no episodes. Give a run folder, or tables: {source}/*.csv."
            raise UsageError(message)
        else:
            gathered.taken.append(take(source, options))
    return gathered


def _with_own_ids(read: ReadRun, earlier: Iterable[ReadRun]) -> ReadRun:
    """Rename episodes that an earlier run has too; copies of the same file count there alone."""
    hashes = {e.facts.info.id: e.file.sha256 for e in read.contents.recorded}
    for other in earlier:
        theirs = {e.facts.info.id: e.file.sha256 for e in other.contents.recorded}
        copies = {name for name in hashes if theirs.get(name) == hashes[name]}
        if copies:
            read = read.without(copies, f"the same file is in {other.run.path}: it counts there")
        ids = {row.episode for row in other.rows}
        alike = {row.episode for row in read.rows if row.episode in ids}
        where = read.name if read.name != other.name else read.run.path.resolve().as_posix()
        read = read.renamed({name: f"{where}/{name}" for name in alike})
    return read


def _trials(gathered: _Gathered) -> Comparison:
    """Measure trials of runs and tables together."""
    rows = gathered.rows()
    if rows:
        together = [*(row for read in gathered.reads for row in read.rows), *rows]
        refuse_slips((row, row.episode) for row in together)
    if gathered.reads:
        base = compare_read(gathered.reads, name=gathered.name, more_rows=rows)
        alone = (f"images: {ALONE}", f"imported motions: {ALONE}")
        base = replace(base, missing=(*base.missing, *alone))
    else:
        stand_in = stand_in_of(row.stand_in for row in rows)
        base = compare_rows(rows, run=gathered.name, source="trials", stand_in=stand_in)
    return _from(replace(base, exclusions=(*unknown_sides(rows), *base.exclusions)), gathered)


def _rates(gathered: _Gathered) -> Comparison:
    """Measure rates of tables together; a cell that two tables give is refused."""
    seen: dict[tuple[str, ...], Path] = {}
    for each in gathered.taken:
        for record in each.rates:
            key = (record.task, record.condition, record.policy, record.side)
            if seen.setdefault(key, each.path) != each.path:
                cell = ", ".join(filter(None, key))
                message = f"{cell} stands in {seen[key]} and in {each.path}. Give each cell once."
                raise UsageError(message)
    records = [record for each in gathered.taken for record in each.rates]
    refuse_slips((record, f"row {record.row}") for record in records)
    return _from(compare_records(records, gathered.name), gathered)


def refuse_slips(named: Iterable[tuple[TrialRow | RateRecord, str]]) -> None:
    """Refuse names of a table that differ only by case, blanks or signs, and name both."""
    found = list(named)
    for kind in ("task", "condition", "policy"):
        names = ((getattr(each, kind), where) for each, where in found)
        refuse_alike(kind, names, lambda name: slug(name.casefold()))


def _from(base: Comparison, gathered: _Gathered) -> Comparison:
    """Add where everything came from."""
    return replace(
        base,
        provenance={
            **(base.provenance or {"software": software()}),
            "files": {str(each.path): hash_file(each.path) for each in gathered.taken},
            "read_as": [each.summary for each in gathered.taken],
        },
    )
