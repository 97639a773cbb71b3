"""Read a run folder into a ``Comparison``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.errors import BridgeError, GstError
from bridge.exchange.trials_import import trials_path
from evaluator.compare.bands import compare_bands
from evaluator.compare.cells import cell_agreement
from evaluator.compare.decisions import decisions
from evaluator.compare.fewer import assisted_rates, sequences, stopping_table
from evaluator.compare.gains import gain_tests, replanning_gains
from evaluator.compare.imported import imported_rows
from evaluator.compare.pairing import START_LIMIT_M, pair_starts, paired_gain, start_distances
from evaluator.compare.remarks import remarks, remarks_table
from evaluator.compare.replays import DerivedFile, read_derived
from evaluator.compare.rows import Comparison, TrialRow
from evaluator.compare.stages import failures_table, stage_results
from evaluator.compare.success import (
    WITH,
    WITHOUT,
    averages,
    never_sent,
    rate_cells,
    side_rates,
    trials_in,
)
from evaluator.compare.tables import (
    confusion_table,
    gains_table,
    layout_table,
    success_table,
    trials_table,
)
from evaluator.compare.tracking import tcp_measurements
from evaluator.compare.trial import read_trial
from evaluator.compare.verdicts import agreement, gate_worth, reliability
from evaluator.compare.views import compare_views
from evaluator.result import Exclusion, Measurement, Table


def compare_run(run: RunFolder, *, method: str = "wilson", goal: float | None = None) -> Comparison:
    """Pair every recorded trial of a run with its replays and measure the agreement.

    A broken episode is left out and named; a missing part is listed, never guessed.

    Raises:
        PathNotFoundError: When the run folder is not there.
    """
    run = RunFolder.open(run.path)
    recorded, left_out = _read_recorded(run)
    files, broken = read_derived(run)
    left_out += broken
    hashes = {episode.path: episode.sha256() for episode in recorded}
    rows = []
    for episode in recorded:
        if episode.info.kind != "trial":
            continue
        try:
            row, lacking = read_trial(run, episode, files, sha256=hashes[episode.path])
        except GstError as error:
            left_out.append(_broken(episode.info.id, error))
            continue
        rows.append(row)
        left_out += lacking
    imported, doubled = imported_rows(run, {episode.info.id for episode in recorded})
    rows += imported
    left_out += doubled
    views = compare_views(files, recorded, hashes)
    bands = compare_bands(recorded, files)
    base = compare_rows(
        rows,
        run=run.path.resolve().name,
        source="run",
        stand_in=_stand_in(recorded, files, imported),
        method=method,
        goal=goal,
    )
    missing = [] if rows else ["trials: the run holds no recorded trial"]
    return replace(
        base,
        measurements=(*base.measurements, *views.measurements, *bands.measurements),
        tables=(*base.tables, *views.tables, *bands.tables),
        exclusions=(*left_out, *base.exclusions, *views.exclusions, *bands.exclusions),
        missing=(*missing, *base.missing, *views.missing, *bands.missing),
        provenance={
            "software": software(),
            "start_limit_m": START_LIMIT_M,
            "imported_trials": hash_file(trials_path(run)) if imported or doubled else None,
            "episodes": {_name_of(path, run): sha256 for path, sha256 in hashes.items()},
            "derived": {
                _name_of(file.path, run): {
                    "sha256": hash_file(file.path),
                    "source_sha256": file.derived.source_sha256,
                    "scene_hash": file.derived.scene_hash,
                    "engine": file.derived.engine,
                    "seed": file.derived.seed,
                }
                for file in files
            },
        },
    )


def compare_rows(
    rows: Sequence[TrialRow],
    *,
    run: str,
    source: str,
    stand_in: bool | None,
    method: str = "wilson",
    goal: float | None = None,
) -> Comparison:
    """Measure everything that follows from trial rows alone, wherever they came from.

    Args:
        rows: One for each trial, or, from a streamed table, one for equal trials.
        run: Name of the run or table.
        source: run or trials.
        stand_in: Whether the recorded side is a simulated laboratory.
        method: Interval of rates: wilson, clopper-pearson or jeffreys.
        goal: Success rate to stop or continue for.
    """
    if not rows:
        return Comparison(run=run, source=source, stand_in=stand_in)
    word = Comparison(run=run, source=source, stand_in=stand_in).recorded_word
    rates = side_rates(rows, method=method)
    cells = rate_cells(rows, rates, method=method)
    gains = replanning_gains(cells, method=method)
    pairs, unpaired = pair_starts(rows)
    worth, worth_tables = gate_worth(rows)
    kept, kept_tables = reliability(rows)
    stages, stage_tables, other_stages = stage_results(rows)
    chosen, decision_tables = decisions(cells)
    measurements: list[Measurement] = [
        *rates,
        *(rate for cell in cells for rate in cell.pair),
        *averages(cells, method=method),
        *agreement(rows, method=method),
        *cell_agreement(cells),
        *gains,
        *gain_tests(cells),
        *paired_gain(pairs),
        *start_distances(pairs),
        *never_sent(rows),
        *worth,
        *kept,
        *stages,
        *chosen,
        *assisted_rates(rows),
        *sequences(rows, pairs),
        *(tcp_measurements(rows) if any(row.tcp_errors for row in rows) else ()),
    ]
    streamed = any(not row.episode for row in rows)
    tables: tuple[Table, ...] = (
        success_table(cells, word),
        *layout_table(cells, measurements, word),
        *gains_table(gains, word),
        *remarks_table(remarks(cells, measurements)),
        confusion_table(rows, word),
        *worth_tables,
        *kept_tables,
        *stage_tables,
        *failures_table(rows, word),
        *decision_tables,
        *stopping_table(rows, goal),
        *(() if streamed else (trials_table(rows, word),)),
    )
    return Comparison(
        run=run,
        source=source,
        stand_in=stand_in,
        rows=tuple(rows),
        cells=cells,
        measurements=tuple(measurements),
        tables=tables,
        exclusions=(*unpaired, *other_stages),
        missing=tuple(_missing(rows, measurements)),
    )


NO_DATA = (
    ("reliability.", "reliability of the success probability", "no trial has p_success"),
    ("stage.", "stage funnel", "no trial has labelled stages or counts sub-tasks"),
    (
        "proxy.",
        "recorded rate with the twin's help",
        "every start in the twin has its robot trial, or none has",
    ),
)
"""Parts of the evaluation whose input a run may not have."""


STREAMED = "a streamed table keeps no single trials"


def _missing(rows: Sequence[TrialRow], measurements: Sequence[Measurement]) -> list[str]:
    found = []
    conditions = {row.condition for row in rows}
    if not {WITH, WITHOUT} <= conditions:
        there = ", ".join(sorted(name or "unnamed" for name in conditions))
        found.append(f"replanning gain: it needs both conditions, there is only {there}")
    for side, words in (
        ("sim_planned", "a decided dynamic replay of the plan sent"),
        ("verdict", "a verdict before motion"),
        ("sim_executed", "a dynamic replay of the executed joints"),
    ):
        without = trials_in(row for row in rows if getattr(row, side) is None)
        if without:
            found.append(f"{side}: {without} of {trials_in(rows)} trials have no {words[2:]}")
    streamed = any(not row.episode for row in rows)
    found += [
        f"{words}: no data ({STREAMED if streamed else why})"
        for start, words, why in NO_DATA
        if not any(m.id.startswith(start) for m in measurements)
    ]
    return found


def _read_recorded(run: RunFolder) -> tuple[list[Episode], list[Exclusion]]:
    episodes, left_out = [], []
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            _ = episode.info, episode.outcome  # both are needed; another program may have erred
            episodes.append(episode)
        except BridgeError as error:
            left_out.append(_broken(path.name, error))
    return episodes, left_out


def _broken(name: str, error: GstError) -> Exclusion:
    return Exclusion(episode=name, scope="everything", reason=str(error))


def _stand_in(
    recorded: Sequence[Episode], files: Sequence[DerivedFile], imported: Sequence[TrialRow]
) -> bool | None:
    """True as soon as one episode is a stand-in's: mixed results are not called real."""
    marks = [episode.info.stand_in for episode in recorded]
    marks += [file.episode.info.stand_in for file in files]
    marks += [row.stand_in for row in imported]
    return any(marks) if marks else None


def _name_of(path: Path, run: RunFolder) -> str:
    return path.relative_to(run.path).as_posix()
