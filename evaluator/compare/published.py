"""Recompute a published success table from its own rows, and say where its figures differ.

The table is a rates CSV with two more columns: a row with a ``statistic`` holds a printed figure
(``printed``) instead of a rate. docs/examples/paper_table_published.csv is one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from itertools import product
from pathlib import Path

from bridge.episode.provenance import hash_file, software
from bridge.exchange import trials_rates
from bridge.exchange.table_text import AS_SAVED, SourceRow, TableError, TableOptions, read_rows
from bridge.exchange.trials_csv import SIDES
from evaluator.compare.agreement import sides, usable_groups
from evaluator.compare.notes import with_notes
from evaluator.compare.rates import compare_records
from evaluator.compare.rows import Comparison, RateGroup
from evaluator.compare.success import WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Table
from evaluator.statistics.agreement import bias, mean_rate, mmrv, pearson, spearman
from evaluator.statistics.intervals import relative_gain

EXTRA = ("statistic", "printed")
OF_ONE_SIDE = ("average_percent", "gain_pp", "gain_relative_percent")
"""Statistics that must say whose rates they are about."""
STATISTICS = (*OF_ONE_SIDE, *["pearson_r", "spearman_rho", "bias_pp", "mae_pp", "rmse_pp", "mmrv"])
AS_PRINTED, ROUNDED, DIFFERS = "as printed", "only from rounded figures", "differs"
WITHIN = "within the rounding of its rates"
IMPOSSIBLE, UNDEFINED, NOT_PRINTED = "impossible", "undefined", "not in the table"
AMBIGUOUS = "ambiguous"
SWAPPED = "fits with arguments swapped"
FEWEST = 3
"""Groups from which r is defined."""
FAILED = (ROUNDED, DIFFERS, IMPOSSIBLE, UNDEFINED)


@dataclass(frozen=True)
class Finding:
    """One printed figure against what its rows give."""

    row: int | None
    """As a spreadsheet numbers it; None for what the table does not print."""
    what: str
    printed: str
    recomputed: float | None
    """None where the rows give none, or several."""
    verdict: str
    note: str = ""
    instead: str = ""
    """What stands in the place of a number that is not there."""


@dataclass(frozen=True, kw_only=True)
class _Claim:
    row: SourceRow
    statistic: str
    task: str
    """Empty for a figure over all tasks."""
    side: str
    condition: str
    policy: str
    value: Decimal
    half: Fraction
    """Half a unit of the last printed digit."""


@dataclass(frozen=True, kw_only=True)
class PublishedCheck:
    """The recomputed table, and every figure that was looked at."""

    comparison: Comparison
    findings: tuple[Finding, ...]

    @property
    def failed(self) -> tuple[Finding, ...]:
        """Figures that do not follow from the rows."""
        return tuple(finding for finding in self.findings if finding.verdict in FAILED)


def check_published(path: Path, options: TableOptions = AS_SAVED) -> PublishedCheck:
    """Recompute every printed figure of a table.

    Raises:
        TableError: Naming the row that cannot be read at all, or that is there twice.
    """
    records: list[trials_rates.RateRecord] = []
    claims: list[_Claim] = []
    findings: list[Finding] = []
    for row in read_rows(path, ("task", "side", *EXTRA), (*trials_rates.COLUMNS, *EXTRA), options):
        if row.text("statistic"):
            claims.append(_claim(row))
            continue
        record, finding = _read(row)
        trials_rates.check_beside(row, record, records)
        records.append(record)
        findings += [] if finding is None else [finding]
    comparison = compare_records(records, path.stem)
    groups = usable_groups(comparison.groups)
    halves: Halves = {
        (r.task, r.condition, r.policy, "sim" if r.side == "sim" else "recorded"): r.half
        for r in records
    }
    findings += [_judge(claim, groups, claims, halves) for claim in claims]
    findings += _not_printed(groups, claims)
    about = [(f.what, f.note) for f in findings if f.note]
    tables = (_table(findings), *with_notes(comparison.tables, about))
    provenance = {"software": software(), "files": {str(path): hash_file(path)}}
    comparison = replace(comparison, tables=tables, provenance=provenance)
    return PublishedCheck(comparison=comparison, findings=tuple(findings))


def _claim(row: SourceRow) -> _Claim:
    statistic = row.text("statistic")
    if statistic not in STATISTICS:
        raise row.refuse(f"statistic is {statistic!r}", f"Statistics: {', '.join(STATISTICS)}")
    try:
        value = Decimal(row.text("printed").removesuffix("%"))
    except InvalidOperation:
        value = Decimal("NaN")
    if not trials_rates.is_figure(value):
        raise row.refuse(f"printed is {row.text('printed')!r}", "Give a number")
    side = row.text("side")
    if side not in SIDES and (side or statistic in OF_ONE_SIDE):
        raise row.refuse(f"side of {statistic} is {side!r}", f"Sides: {', '.join(SIDES)}")
    return _Claim(
        row=row,
        statistic=statistic,
        side="sim" if side == "sim" else "recorded",
        **{name: row.text(name) for name in ("task", "condition", "policy")},
        value=value,
        half=trials_rates.half_digit(value),
    )


def _read(row: SourceRow) -> tuple[trials_rates.RateRecord, Finding | None]:
    """Read a rate; one that no count gives, or several, is kept without n, and said."""
    k, n = row.text("k"), row.text("n")
    refusal: TableError
    try:
        return trials_rates.read_rate(row), None
    except trials_rates.ImpossibleRateError as error:
        refusal, instead, verdict = error, f"{k}/{n}" if k else f"no count of {n}", IMPOSSIBLE
    except trials_rates.AmbiguousRateError as error:
        refusal, instead, verdict = error, f"several counts of {n}", AMBIGUOUS
    printed = trials_rates.printed_rate(row)
    if printed is None:
        raise refusal
    what = " ".join(filter(None, map(row.text, ("task", "condition", "side"))))
    text = row.text("rate_percent") or row.text("rate")
    note = str(refusal).partition(f" row {row.row}: ")[2]
    kept = {name: text for name, text in row.values.items() if name not in ("k", "n")}
    return trials_rates.read_rate(replace(row, values=kept)), Finding(
        row.row, what, text, None, verdict, note, instead
    )


Halves = Mapping[tuple[str, ...], Fraction]
"""How far each rate may lie from the printed one, by task, condition, policy and side."""


def _judge(
    claim: _Claim, groups: Sequence[RateGroup], claims: Sequence[_Claim], halves: Halves
) -> Finding:
    side = claim.side if claim.statistic in OF_ONE_SIDE else ""
    parts = (claim.statistic, claim.task, side, claim.condition, claim.policy)
    what = " ".join(part for part in parts if part)
    groups = [g for g in groups if claim.task in ("", g.task) and claim.policy in ("", g.policy)]
    printed = str(claim.value)
    try:
        value = _value(claim.statistic, claim.side, claim.condition, groups)
    except UndefinedStatisticError as error:
        note = f"printed {printed}, but the rows do not give it: {error.reason}"
        instead = f"undefined: {error.reason}"
        return Finding(claim.row.row, what, printed, None, UNDEFINED, note, instead)
    shown = f"{value:.4g}" if abs(value) < 1 else f"{value:.2f}"
    if _fits(value, claim):
        verdict, note = AS_PRINTED, ""
    else:
        low, high = _reach(claim, groups, halves)
        reach = f", or from {low:.4g} to {high:.4g} as its rates are rounded" if high > low else ""
        verdict, note = DIFFERS, f"printed {printed}, the rows give {shown}{reach}"
        if low - float(claim.half) <= float(claim.value) <= high + float(claim.half):
            verdict, note = WITHIN, f"the rows give {shown}{reach}"
            claims = ()
        else:
            verdict, note = _fits_otherwise(claim, groups, shown) or (verdict, note)
        if (rounded := _from_rounded(claim, claims)) is not None and _fits(rounded, claim):
            verdict = ROUNDED
            note = f"{printed} comes from the rounded averages; unrounded it is {shown}"
    return Finding(claim.row.row, what, printed, value, verdict, note)


def _fits_otherwise(
    claim: _Claim, groups: Sequence[RateGroup], shown: str
) -> tuple[str, str] | None:
    """Try MMRV with its arguments swapped."""
    if claim.statistic != "mmrv":
        return None
    try:
        swapped = _value("mmrv_sim_gap", claim.side, claim.condition, groups)
    except UndefinedStatisticError:
        return None
    note = f"the gap of sim rates is weighted; by the gap of recorded rates it is {shown}"
    return (SWAPPED, note) if _fits(swapped, claim) else None


def _fits(value: float, claim: _Claim) -> bool:
    return abs(Fraction(value) - Fraction(claim.value)) <= claim.half + Fraction(1, 10**9)


def _value(statistic: str, side: str, condition: str, groups: Sequence[RateGroup]) -> float:
    """Recompute one statistic from the groups, over one condition or all."""
    recorded, sim = sides([group for group in groups if condition in ("", group.condition)])
    if statistic == "average_percent":
        return 100 * mean_rate(sim if side == "sim" else recorded)
    if statistic in ("gain_pp", "gain_relative_percent"):
        before = _value("average_percent", side, WITHOUT, groups)
        after = _value("average_percent", side, WITH, groups)
        return after - before if statistic == "gain_pp" else 100 * relative_gain(before, after)
    if statistic == "pearson_r":
        return pearson(recorded, sim)
    if statistic == "spearman_rho":
        return spearman(recorded, sim)
    if statistic in ("mmrv", "mmrv_sim_gap"):
        return mmrv(recorded=recorded, sim=sim, gap="recorded" if statistic == "mmrv" else "sim")
    gap = bias(recorded=recorded, sim=sim)  # refuses where there is no group
    gaps = [float(b - a) for a, b in zip(recorded, sim, strict=True)]
    if statistic == "mae_pp":
        return 100 * sum(map(abs, gaps)) / len(gaps)
    if statistic == "rmse_pp":
        return 100 * math.sqrt(sum(each**2 for each in gaps) / len(gaps))
    return 100 * gap


PASSES = 4
"""Rounds of the search; each moves every rate once, and nearly always the second one changes none.
"""


def _reach(claim: _Claim, groups: Sequence[RateGroup], halves: Halves) -> tuple[float, float]:
    """Return the least and the most that a figure can be while every rate rounds to its print.

    Found by moving one rate at a time to the end of its rounding, or back, as long as that helps:
    exact for what is linear in the rates, and an inner bound for the others.
    """
    ends = []
    for sign in (-1, 1):
        moved = list(groups)
        best = sign * _value(claim.statistic, claim.side, claim.condition, moved)
        for _ in range(PASSES):
            before = best
            for place, side in product(range(len(moved)), ("recorded", "sim")):
                group = groups[place]
                half = halves.get((group.task, group.condition, group.policy, side), Fraction(0))
                for step in (-half, half) if half else ():
                    tried = [*moved]
                    tried[place] = _with_rate(moved[place], group, side, step)
                    try:
                        value = sign * _value(claim.statistic, claim.side, claim.condition, tried)
                    except UndefinedStatisticError:
                        continue
                    if value > best:
                        best, moved = value, tried
            if best == before:
                break
        ends.append(sign * best)
    return ends[0], ends[1]


def _with_rate(now: RateGroup, printed: RateGroup, side: str, step: Fraction) -> RateGroup:
    name = f"{side}_rate"
    if (rate := getattr(printed, name)) is None:
        return now
    return replace(now, **{name: min(max(rate + step, Fraction(0)), Fraction(1))})


def _from_rounded(claim: _Claim, claims: Sequence[_Claim]) -> float | None:
    """Recompute a gain from the averages as they are printed."""
    if claim.task or claim.statistic not in ("gain_pp", "gain_relative_percent"):
        return None
    averages = {
        other.condition: float(other.value)
        for other in claims
        if other.statistic == "average_percent" and (other.side, other.task) == (claim.side, "")
    }
    if not {WITHOUT, WITH} <= averages.keys() or not averages[WITHOUT]:
        return None
    before, after = averages[WITHOUT], averages[WITH]
    return after - before if claim.statistic == "gain_pp" else 100 * relative_gain(before, after)


def _not_printed(groups: Sequence[RateGroup], claims: Sequence[_Claim]) -> list[Finding]:
    """What a success table of both sides invites, where it is not printed.

    r inside each task, in each condition and over all; over all groups rank agreement and errors,
    MMRV in both orders of its arguments.
    """
    asked = [claim for claim in claims if claim.statistic == "pearson_r" and not claim.policy]
    whole = [claim.condition for claim in asked if not claim.task]
    parts: list[tuple[str, str, Sequence[RateGroup]]] = []
    for task in dict.fromkeys(group.task for group in groups):
        members = [group for group in groups if group.task == task]
        if task not in {claim.task for claim in asked} and len(members) < len(groups):
            parts.append(("pearson_r", task, members))
    for condition in dict.fromkeys(group.condition for group in groups):
        if condition and condition not in whole:
            members = [group for group in groups if group.condition == condition]
            parts.append(("pearson_r", condition, members))
    parts = [part for part in parts if len(part[2]) >= FEWEST]
    if "" not in whole:
        parts.append(("pearson_r", "all groups", groups))
    if len(groups) >= FEWEST:
        others = ("spearman_rho", "mmrv", "mmrv_sim_gap", "mae_pp", "rmse_pp")
        printed = {claim.statistic for claim in claims}
        parts += [(each, "all groups", groups) for each in others if each not in printed]
    findings = []
    for statistic, words, those in parts:
        value, instead = None, ""
        try:
            value = _value(statistic, "", "", those)
        except UndefinedStatisticError as error:
            instead = f"undefined: {error.reason}"
        what = f"{statistic} {words} (n = {len(those)})"
        findings.append(Finding(None, what, "", value, NOT_PRINTED, instead=instead))
    return findings


def _table(findings: Sequence[Finding]) -> Table:
    return Table(
        id="published",
        title="Printed figures, recomputed from the table's own rows",
        columns=("row", "figure", "printed", "recomputed", "instead", "verdict", "note"),
        rows=tuple(
            (
                *(f.row, f.what, f.printed or None, f.recomputed, f.instead or None),
                *(f.verdict, f.note or None),
            )
            for f in findings
        ),
        note="A figure fits when it rounds to what is printed. Within the rounding: it does for "
        "rates that round to the printed ones. Fits with arguments swapped: MMRV weighted by the "
        "gap of sim rates, where its definition (Li et al. 2024) weights by the gap of recorded "
        "rates. Ambiguous: several counts round to the "
        "rate, so it has no interval here. Row numbers as in the CSV.",
    )
