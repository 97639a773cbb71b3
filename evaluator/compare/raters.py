"""Several raters of the same trials: how far they agree, and what label error does to PPV and r."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64

from bridge.exchange.reviews import OPERATOR, Review
from evaluator.compare.rows import Comparison, TrialRow
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Cell, Table
from evaluator.statistics.gate import Confusion, kappa

SEED, DRAWS = 0, 2000
FEWEST = 8
"""Trials rated twice below which an interval of kappa says nothing."""
ERRORS = (0.02, 0.05, 0.1)
"""Shares of wrong labels that are tried beside the one that the raters show."""
MIN_GROUPS = 3
QUANTILES = (0.025, 0.5, 0.975)
Labels = Mapping[str, bool]


def with_reviews(comparison: Comparison, reviews: Sequence[Review]) -> Comparison:
    """Add what other raters say to an evaluation: kappa, PPV and r by rater, label error.

    Args:
        reviews: Labels of other raters; of trials that are not there they are named.
    """
    rows = {row.episode: row for row in comparison.rows}
    raters: dict[str, dict[str, bool]] = {OPERATOR: {}}
    for row in comparison.rows:
        if row.recorded is not None:
            raters[OPERATOR][row.episode] = row.recorded
    for review in reviews:
        if review.trial_id in rows and review.success is not None:
            raters.setdefault(review.rater, {})[review.trial_id] = review.success
    strange = sorted({r.trial_id for r in reviews} - rows.keys())
    missing = comparison.missing
    if strange:
        shown = ", ".join(strange[:3])
        missing = (*missing, f"reviews: {len(strange)} of trials that are not there ({shown})")
    agreement = [_agreement(a, b, raters) for a, b in combinations(raters, 2)]
    agreement = [line for line in agreement if line["trials"]]
    if not agreement:
        return replace(comparison, missing=(*missing, "raters: no trial has two known labels"))
    tables = (_rater_table(agreement), *_label_tables(rows, raters, agreement), *_causes(reviews))
    return replace(comparison, tables=(*comparison.tables, *tables), missing=missing)


def _rater_table(lines: Sequence[dict[str, Cell]]) -> Table:
    return Table.of(
        lines,
        id="raters",
        title="Agreement of raters",
        note="Kappa: Cohen's (1960), agreement beyond chance; 1 is full agreement. Brackets: 95 % "
        f"percentiles of trials drawn anew, from {FEWEST} trials on.",
    )


def _agreement(first: str, second: str, raters: Mapping[str, Labels]) -> dict[str, Cell]:
    shared = sorted(raters[first].keys() & raters[second].keys())
    pairs = [(raters[first][name], raters[second][name]) for name in shared]
    line: dict[str, Cell] = {
        "rater": first,
        "other rater": second,
        "trials": len(pairs),
        "agree": sum(a == b for a, b in pairs),
        "only the first says success": sum(a and not b for a, b in pairs),
        "only the other says success": sum(b and not a for a, b in pairs),
        "kappa": None,
        "low": None,
        "high": None,
        "why undefined": None,
    }
    try:
        line["kappa"] = kappa(Confusion.count(pairs))
    except UndefinedStatisticError as error:
        line["why undefined"] = error.reason
        return line
    if len(pairs) >= FEWEST:
        values = _kappas(np.array(pairs))
        if len(values) > DRAWS // 2 and np.ptp(values) > 0:
            line["low"], line["high"] = (float(v) for v in np.quantile(values, [0.025, 0.975]))
    return line


def _kappas(pairs: Bool[np.ndarray, "trials 2"]) -> Float64[np.ndarray, " draws"]:
    """Kappa of trials drawn anew; draws in which it is undefined are left out."""
    rng = np.random.default_rng(SEED)
    a, b = pairs[rng.integers(len(pairs), size=(DRAWS, len(pairs)))].transpose(2, 0, 1)
    p, q = a.mean(axis=1), b.mean(axis=1)
    chance = p * q + (1 - p) * (1 - q)
    kept = chance < 1
    agreed = (a == b).mean(axis=1)
    return np.asarray((agreed[kept] - chance[kept]) / (1 - chance[kept]))


def _label_tables(
    rows: Mapping[str, TrialRow],
    raters: Mapping[str, Labels],
    agreement: Sequence[dict[str, Cell]],
) -> tuple[Table, ...]:
    """PPV and r with the labels of each rater, and under wrong labels at random."""
    answered = {n: row for n, row in rows.items() if row.sim_planned is not None}
    lines: list[dict[str, Cell]] = []
    for rater, labels in raters.items():
        both = [name for name in labels if name in answered]
        ppv, r = _ppv_and_r([answered[n] for n in both], np.array([[labels[n] for n in both]]))
        lines.append(_label_line(f"labels of {rater}", len(both), ppv, r))
    both = [name for name in raters[OPERATOR] if name in answered]
    operator = np.array([raters[OPERATOR][name] for name in both])
    disagree = [1 - int(str(x["agree"])) / int(str(x["trials"])) for x in agreement]
    shown = max(disagree) / 2  # of two raters who disagree one is wrong
    rng = np.random.default_rng(SEED)
    for share in sorted({*ERRORS, round(shown, 3)}):
        flipped = operator[None, :] ^ (rng.random((DRAWS, len(operator))) < share)
        found = _ppv_and_r([answered[name] for name in both], flipped)
        words = f"{100 * share:g} % of labels wrong at random"
        words += " (half of what raters disagree on)" if share == round(shown, 3) else ""
        lines.append(_label_line(words, len(both), *found))
    note = (
        "Rows of raters: their own labels in place of the recorded ones, over the trials they "
        "rated. Wrong at random: each recorded label flipped with that chance; median and 95 % of "
        f"{DRAWS} draws. PPV: success when sim says success."
    )
    return (Table.of(lines, id="label_error", title="What label error does", note=note),)


def _label_line(
    words: str, n: int, ppv: Float64[np.ndarray, " draws"], r: Float64[np.ndarray, " draws"]
) -> dict[str, Cell]:
    line: dict[str, Cell] = {"labels": words, "trials": n}
    for name, values in (("PPV", ppv), ("Pearson r", r)):
        known = values[np.isfinite(values)]
        line |= {name: None, f"{name} low": None, f"{name} high": None}
        if len(known):
            low, middle, high = (round(float(v), 3) for v in np.quantile(known, QUANTILES))
            line[name] = middle
            if len(known) > 1:
                line |= {f"{name} low": low, f"{name} high": high}
    return line


def _ppv_and_r(
    rows: Sequence[TrialRow], labels: Bool[np.ndarray, "draws trials"]
) -> tuple[Float64[np.ndarray, " draws"], Float64[np.ndarray, " draws"]]:
    """PPV and r over groups for each set of labels; NaN where undefined."""
    accepted = np.array([bool(row.sim_planned) for row in rows])
    keys = [(row.task, row.condition, row.policy) for row in rows]
    with np.errstate(invalid="ignore", divide="ignore"):
        ppv = (
            (labels & accepted).sum(axis=1) / accepted.sum()
            if accepted.any()
            else np.full(len(labels), np.nan)
        )
        groups = [np.array([key == other for other in keys]) for key in dict.fromkeys(keys)]
        if len(groups) < MIN_GROUPS:
            return np.asarray(ppv, dtype=float), np.full(len(labels), np.nan)
        x = np.array([labels[:, group].mean(axis=1) for group in groups])
        y = np.array([accepted[group].mean() for group in groups])[:, None]
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        r = (x * y).sum(axis=0) / np.sqrt((x * x).sum(axis=0) * (y * y).sum(axis=0))
    return np.asarray(ppv, dtype=float), np.asarray(r, dtype=float)


def _causes(reviews: Sequence[Review]) -> tuple[Table, ...]:
    """Count the causes of failure that each rater gave."""
    counts = Counter((review.rater, review.cause) for review in reviews if review.cause)
    if not counts:
        return ()
    rows: list[dict[str, Cell]] = [
        {"rater": rater, "cause": cause, "trials": count}
        for (rater, cause), count in sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    ]
    return (Table.of(rows, id="review_causes", title="Causes that raters gave"),)
