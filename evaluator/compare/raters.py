"""Several raters of the same trials: how far they agree."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64

from bridge.exchange.reviews import OPERATOR, Review
from evaluator.compare.rows import Comparison
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Cell, Table
from evaluator.statistics.gate import Confusion, kappa

SEED, DRAWS = 0, 2000
FEWEST = 8
"""Trials rated twice below which an interval of kappa says nothing."""
Labels = Mapping[str, bool]


def with_reviews(comparison: Comparison, reviews: Sequence[Review]) -> Comparison:
    """Add what other raters say to an evaluation: kappa of each two raters."""
    rows = {row.episode: row for row in comparison.rows}
    labelled = {name: row.recorded for name, row in rows.items() if row.recorded is not None}
    raters: dict[str, dict[str, bool]] = {OPERATOR: labelled}
    for review in reviews:
        if review.trial_id in rows and review.success is not None:
            raters.setdefault(review.rater, {})[review.trial_id] = review.success
    missing = comparison.missing
    if strange := sorted({r.trial_id for r in reviews} - rows.keys()):
        shown = ", ".join(strange[:3])
        missing = (*missing, f"reviews: {len(strange)} of trials that are not there ({shown})")
    lines = [x for a, b in combinations(raters, 2) if (x := _agreement(a, b, raters))["trials"]]
    if not lines:
        return replace(comparison, missing=(*missing, "raters: no trial has two known labels"))
    table = Table.of(
        lines,
        id="raters",
        title="Agreement of raters",
        note="Kappa: Cohen's (1960), agreement beyond chance; 1 is full agreement. Brackets: 95 % "
        f"percentiles of trials drawn anew, from {FEWEST} trials on.",
    )
    return replace(comparison, tables=(*comparison.tables, table), missing=missing)


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
        **dict.fromkeys(("kappa", "low", "high", "why undefined")),
    }
    try:
        line["kappa"] = kappa(Confusion.of(pairs))
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
    return np.asarray(((a == b).mean(axis=1)[kept] - chance[kept]) / (1 - chance[kept]))
