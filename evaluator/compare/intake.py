"""What a table of somebody's results holds, as far as its own words tell.

Known are tables of trials and of rates, and of printed figures. An outcome is never guessed: a
table that does not say it is refused, with the reason.
"""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bridge.errors import UsageError
from bridge.exchange import table_text, trials_csv
from bridge.exchange.trials_rates import COLUMNS as RATE_COLUMNS
from bridge.exchange.trials_rates import RateRecord
from evaluator.compare.found_table import read_found
from evaluator.compare.measure import refuse_changed
from evaluator.compare.table_words import KNOWN, is_number, is_share

PUBLISHED = "a published table"


@dataclass(frozen=True, kw_only=True)
class Taken:
    """What one file was taken for."""

    path: Path
    kind: str
    summary: str
    trials: tuple[trials_csv.TrialRecord, ...] = ()
    rates: tuple[RateRecord, ...] = ()


def take(path: Path, options: table_text.TableOptions = table_text.AS_SAVED) -> Taken:
    """Read a file; its content tells what it is."""
    if path.suffix.lower() == ".json":
        raise UsageError(f"{path} is JSON. Save it as a table: CSV, TSV, text or .xlsx.")
    known = (*trials_csv.COLUMNS, *RATE_COLUMNS, "statistic", "printed")
    _refuse_unknown(options, known)
    table = table_text.open_table(path, known, options, near=False, words=KNOWN)
    header = set(table.header)
    _refuse_changed(table)
    if "statistic" in header:
        return Taken(path=path, kind=PUBLISHED, summary=f"{path.name}: rates with printed figures")
    others = {"side", "real", "sim"} & {*header, *map(table_text.plain_name, table.left)}
    if "task" in header and not others and set(trials_csv.SIDES_OF_TRIAL) & header:
        opened = trials_csv.open_trials(path, _with_outcome(table, options))
        trials = trials_csv.trials_of(table_text.rows_of(opened))
        understood = opened.understood("trials", len(trials))
        return Taken(path=path, kind="trials", summary=understood, trials=tuple(trials))
    found = read_found(path, table.grid, options)
    kind, reach = ("rates", ranges(found.rates)) if found.rates else ("trials", "")
    summary = f"{path.name}: {'; '.join(filter(None, (reach, *found.notes)))}"
    return Taken(path=path, kind=kind, summary=summary, trials=found.trials, rates=found.rates)


def _refuse_changed(table: table_text.TableText) -> None:
    """Refuse a policy that was another checkpoint before: one name would stand for both."""
    plain = list(map(table_text.plain_name, table.header))
    if {"policy", "checkpoint"} <= set(plain):
        policy, who = (plain.index(name) for name in ("policy", "checkpoint"))
        rows = (
            (f"{table.path} row {n}", [*cells, *[""] * len(plain)]) for n, cells in table.grid[1:]
        )
        refuse_changed((where, row[policy].strip(), row[who].strip()) for where, row in rows)


def _with_outcome(
    table: table_text.TableText, options: table_text.TableOptions
) -> table_text.TableOptions:
    """Map the one column that is called an outcome, and one of progress and of time, by content."""
    found = [options.map] if options.map else []
    ended, answer = table_text.ENDED, table_text.answer_of
    for ours, names, is_ours in (
        ("recorded", table_text.OUTCOME_LIKE, lambda t: t in ended or answer(t) is not None),
        ("progress", table_text.MEASURED["progress"], is_share),
        ("time_s", table_text.MEASURED["time_s"], is_number),
    ):
        named = [name for name in table.left if table_text.plain_name(name) in names]
        if ours in table.header or len(named) != 1:
            continue
        place = table.header.index(named[0])
        texts = [cells[place].strip().lower() for _, cells in table.grid[1:] if place < len(cells)]
        if all(text in table_text.UNKNOWN or is_ours(text) for text in texts):
            found.append(f"{ours}={named[0]}")
    return replace(options, map=",".join(found))


def ranges(rates: Sequence[RateRecord]) -> str:
    """Say in a few words what rates were understood: groups, and how far each side reaches."""
    groups = len({(r.task, r.condition, r.policy) for r in rates})
    parts = []
    for side in dict.fromkeys(r.side for r in rates):
        shares = [100 * float(r.rate) for r in rates if r.side == side]
        low, high = (f"{end:.3g}" for end in (min(shares), max(shares)))
        parts.append(f"{side} {low} to {high} %" if low != high else f"{side} {low} %")
    without = sum(r.n is None for r in rates)
    lacks = f"; {without} of {len(rates)} rates without n" if without else ""
    return f"{groups} group{'' if groups == 1 else 's'}; {', '.join(parts)}{lacks}"


def _refuse_unknown(options: table_text.TableOptions, known: Sequence[str]) -> None:
    """Refuse a mapping onto a column that no table has."""
    for name in options.mapped:
        if name not in known:
            names = ", ".join(dict.fromkeys(("outcome", *known)))
            likely = difflib.get_close_matches(name, ("outcome", *known), n=1)
            hint = f" Did you mean {likely[0]}?" if likely else ""
            raise UsageError(f"--map {name}=...: no such column.{hint} There are: {names}.")
