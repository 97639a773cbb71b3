"""Several runs, tables and folders of results in one evaluation: groups over all of them."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange.table_text import AS_SAVED, TableOptions
from bridge.terminal import Output
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare.against import against_tables
from evaluator.compare.from_rows import compare_rows
from evaluator.compare.intake import PUBLISHED, Left, Taken, look_through, take
from evaluator.compare.names import settle_names
from evaluator.compare.rates import compare_records
from evaluator.compare.rows import Comparison, TrialRow, stand_in_of
from evaluator.compare.run import QUIET, ReadRun, compare_read, read_run
from evaluator.compare.spreadsheet import row_from_record, unknown_sides
from evaluator.compare.trial import Trial
from evaluator.result import Cell, Exclusion, Table

ALONE = "of several runs together; evaluate each run alone for it"


@dataclass(kw_only=True)
class _Gathered:
    """What the sources hold, before it is measured."""

    reads: list[ReadRun] = field(default_factory=list)
    taken: list[Taken] = field(default_factory=list)
    left: list[Left] = field(default_factory=list)

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


def compare_several(
    sources: Sequence[Path],
    *,
    method: str = "wilson",
    options: TableOptions = AS_SAVED,
    output: Output = QUIET,
) -> Comparison:
    """Compare several runs, tables or folders of results as one study.

    Groups are task x condition x policy over all of them. An episode or trial id that two sources
    have is told apart by the source's name; a file that is there twice counts once. Starts of one
    id are one start, wherever they were tried.
    """
    refuse_twice(sources)
    with ExitStack() as caches:
        gathered = _gather(sources, options, output, caches)
    trials = gathered.rows()
    if not (trials or gathered.reads) and any(each.rates for each in gathered.taken):
        base = _rates_alone(gathered, sources, method, options)
    else:
        base = _trials(gathered, trials, sources, method, options)
    if not base.measurements:
        lines = "\n".join(f"  {one.path}: {one.reason}" for one in gathered.left[:12])
        message = f"Nothing in {_named(sources)} could be read as results.\n{lines}"
        raise UsageError(message.rstrip())
    return replace(base, tables=(*base.tables, *_intake_table(gathered, base)))


def with_against(
    comparison: Comparison,
    source: Path,
    other: Path,
    *,
    options: TableOptions = AS_SAVED,
    output: Output = QUIET,
) -> Comparison:
    """Add the paired comparison with another twin's answers to the same recorded trials."""
    refuse_twice([source, other])
    mine, theirs = (answers_of(path, options, output) for path in (source, other))
    tables = against_tables(
        comparison.rows or mine[0],
        theirs[0],
        names=(source.resolve().stem, other.resolve().stem),
        trials=(mine[1], theirs[1]),
    )
    return replace(comparison, tables=(*comparison.tables, *tables))


def answers_of(
    path: Path, options: TableOptions = AS_SAVED, output: Output = QUIET
) -> tuple[Sequence[TrialRow], Sequence[Trial]]:
    """Read trials with the twin's answers, and of a run the replays behind them."""
    if not (path / "episodes").is_dir():
        return list(map(row_from_record, take(path, options).trials)), ()
    run = RunFolder.open(path)
    with SummaryCache(run.results_dir / FOLDER, say=output.say) as cache:
        read = read_run(run, cache, output)
    return read.rows, read.trials


def refuse_twice(sources: Sequence[Path]) -> None:
    """Refuse a source that is given twice: its trials would count double."""
    seen: set[Path] = set()
    for source in sources:
        if source.resolve() in seen:
            message = f"{source} is given twice; its trials would count double."
            raise UsageError(message)
        seen.add(source.resolve())


def _named(sources: Sequence[Path]) -> str:
    return " + ".join(source.resolve().name for source in sources)


def _gather(
    sources: Sequence[Path],
    options: TableOptions,
    output: Output,
    caches: ExitStack,
) -> _Gathered:
    gathered = _Gathered()
    for source in sources:
        if (source / "episodes").is_dir():
            run = RunFolder.open(source)
            cache = SummaryCache(run.results_dir / FOLDER, say=output.say)
            read = read_run(run, caches.enter_context(cache), output)
            gathered.reads.append(_with_own_ids(read, gathered.reads))
        elif source.is_dir():
            taken, left = look_through(source, options)
            gathered.taken += taken
            gathered.left += left
        else:
            gathered.taken.append(take(source, options))
    kept = _without_copies(gathered)
    for each in kept.taken:
        output.say(f"Read {each.summary}.")
    for one in kept.left:
        output.say(f"Left {one.path}: {one.reason}")
    return kept


def _without_copies(gathered: _Gathered) -> _Gathered:
    """Leave out tables of figures, copies, and rates where there are trials."""
    hashes: dict[str, Path] = {}
    has_trials = bool(gathered.reads) or any(each.trials for each in gathered.taken)
    kept, left = [], list(gathered.left)
    for each in gathered.taken:
        reason = ""
        if each.path.is_file():
            first = hashes.setdefault(hash_file(each.path), each.path)
            reason = "" if first == each.path else f"the same bytes as {first}"
        if each.kind == PUBLISHED:
            reason = "printed figures: --check-published reads it"
        elif each.rates and has_trials:
            reason = "rates, and there are trials: rates that rest on them would count twice"
        if reason:
            left.append(Left(path=each.path, reason=reason))
        else:
            kept.append(each)
    return _Gathered(reads=gathered.reads, taken=kept, left=left)


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


def _trials(
    gathered: _Gathered,
    trials: Sequence[TrialRow],
    sources: Sequence[Path],
    method: str,
    options: TableOptions,
) -> Comparison:
    """Measure trials of runs and tables together."""
    inside = [row for read in gathered.reads for row in read.rows]
    settled, merged = settle_names([*inside, *trials], options.names)
    new = {row.episode: row for row in settled}
    reads = [replace(read, rows=[new[row.episode] for row in read.rows]) for read in gathered.reads]
    rows = settled[len(inside) :]
    if reads:
        base = compare_read(reads, name=_named(sources), more_rows=rows, method=method)
        base = replace(
            base, missing=(*base.missing, f"images: {ALONE}", f"imported motions: {ALONE}")
        )
    else:
        base = compare_rows(
            rows,
            run=_named(sources),
            source="trials",
            stand_in=stand_in_of(row.stand_in for row in rows),
            method=method,
        )
    return _from(base, gathered, unknown_sides(rows), merged)


def _rates_alone(
    gathered: _Gathered, sources: Sequence[Path], method: str, options: TableOptions
) -> Comparison:
    """Measure rates of several tables together; a cell that two tables give is refused."""
    seen: dict[tuple[str, ...], Path] = {}
    for each in gathered.taken:
        for record in each.rates:
            key = (record.task, record.condition, record.policy, record.side)
            if seen.setdefault(key, each.path) != each.path:
                cell = ", ".join(filter(None, key))
                message = f"{cell} stands in {seen[key]} and in {each.path}. Give each cell once."
                raise UsageError(message)
    records = [record for each in gathered.taken for record in each.rates]
    settled, merged = settle_names(records, options.names)
    base = compare_records(settled, gathered.taken[0].path, method=method)
    return _from(replace(base, run=_named(sources)), gathered, (), merged)


def _from(
    base: Comparison,
    gathered: _Gathered,
    left_out: Iterable[Exclusion],
    merged: Sequence[str],
) -> Comparison:
    """Add where everything came from, and what was left."""
    files: Mapping[str, str] = {
        str(each.path): hash_file(each.path) for each in gathered.taken if each.path.is_file()
    }
    provenance = {
        **(base.provenance or {"software": software()}),
        "files": files,
        "read_as": [*(each.summary for each in gathered.taken), *merged],
    }
    return replace(base, provenance=provenance, exclusions=(*left_out, *base.exclusions))


def _intake_table(gathered: _Gathered, base: Comparison) -> tuple[Table, ...]:
    """Say of every source what it was taken for, or why it was left."""
    rows: list[dict[str, Cell]] = []
    for read in gathered.reads:
        holds = f"{len(read.rows):,} trials"
        rows.append({"source": str(read.run.path), "taken for": "run", "holds": holds})
    for each in gathered.taken:
        num = len(each.trials) + len(each.rates)
        holds = f"{num:,} {'rates' if each.rates else 'trials'}"
        rows.append({"source": str(each.path), "taken for": each.kind, "holds": holds})
    rows += [
        {"source": str(one.path), "taken for": "left", "holds": one.reason} for one in gathered.left
    ]
    if not rows:
        return ()
    title = f"What was read, and what was left ({len(base.groups)} groups)"
    return (Table.of(rows, id="intake", title=title),)
