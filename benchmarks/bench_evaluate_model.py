"""Does the model of agreement cover? On the truths of ``agreement_truths.py``, fixed beforehand.

``MODEL_DRAWS`` (20) is the number of studies of each cell (truth, groups, trials, factor of the
twin's trials). Success: least coverage over truths of r and of the bias at least 93 %; mean width
of r at most 1.15 of the narrowest other method that covers 93 % on every truth: compared are
Fisher's interval of the measured r, the jackknife on Fisher's scale, and Fieller's interval of the
covariance without the noise of counting (jackknife).
"""

import os
import time
from collections.abc import Callable
from itertools import product

import numpy as np
from agreement_truths import (
    CROSSED,
    NUM_GROUPS,
    NUM_TRIALS,
    SIM_FACTORS,
    TRUTHS,
    Counts,
    population,
    studies,
)
from measure import ROOT, Target, report_targets
from scipy.stats import t as student

from evaluator.statistics.gap_model import GapModel, GroupCounts

FULL_DRAWS = 20
DRAWS = int(os.environ.get("MODEL_DRAWS", FULL_DRAWS))
if DRAWS != FULL_DRAWS:
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
NEAR = 1e-3
"""The population's correlation is known to so much."""
Study = tuple[Counts, Counts, Counts, Counts]
Ends = tuple[float, float]


def of_model(study: Study, at: int, crossed: bool, groups: int) -> tuple[Ends, Ends]:
    """Ends of r and of the bias by the model under test."""
    k, n, j, m = (side[at] for side in study)
    policies = NUM_GROUPS[groups][1]
    model = GapModel(
        groups=tuple(
            GroupCounts(
                recorded=(int(k[g]), int(n[g])),
                sim=(int(j[g]), int(m[g])),
                shares=(f"task {g // policies}", f"policy {g % policies}") if crossed else (),
            )
            for g in range(groups)
        )
    )
    return (model.r.low, model.r.high), (model.bias.low, model.bias.high)


def fisher(study: Study, at: int) -> Ends:
    """Fisher's interval of the measured correlation; all of the range where there is none."""
    x, y = study[0][at] / study[1][at], study[2][at] / study[3][at]
    if not x.std() or not y.std():
        return -1.0, 1.0
    z = np.arctanh(np.clip(np.corrcoef(x, y)[0, 1], -0.999999, 0.999999))
    half = 1.96 / np.sqrt(len(x) - 3)
    return float(np.tanh(z - half)), float(np.tanh(z + half))


def jackknife(study: Study, at: int) -> Ends:
    """Student's t on Fisher's scale with the error of leaving one group out."""
    x, y = study[0][at] / study[1][at], study[2][at] / study[3][at]
    if not x.std() or not y.std():
        return -1.0, 1.0
    kept = [np.arange(len(x)) != g for g in range(len(x))]
    if any(not x[keep].std() or not y[keep].std() for keep in kept):
        return -1.0, 1.0
    found = np.array([np.corrcoef(x[keep], y[keep])[0, 1] for keep in kept])
    error = np.sqrt((len(x) - 1) * found.var())
    r = float(np.clip(np.corrcoef(x, y)[0, 1], -0.999, 0.999))
    half = student.ppf(0.975, len(x) - 1) * error / (1 - r * r)
    return float(np.tanh(np.arctanh(r) - half)), float(np.tanh(np.arctanh(r) + half))


GRID = np.concatenate([[-1.0], np.tanh(np.linspace(-3.2, 3.2, 127)), [1.0]])


def fieller(study: Study, at: int) -> Ends:
    """All r0 for which cov - r0 sd sd, without the noise of counting, may be 0 (jackknife)."""
    k, n, j, m = (side[at] for side in study)
    x, y = k / n, j / m

    def excess(keep: np.ndarray) -> np.ndarray:
        a, b = x[keep], y[keep]
        noise = a * (1 - a) / np.maximum(n[keep] - 1, 1), b * (1 - b) / np.maximum(m[keep] - 1, 1)
        spread = [max(v.var(ddof=1) - e.mean(), 1e-4) for v, e in zip((a, b), noise, strict=True)]
        return np.asarray(np.cov(a, b)[0, 1] - GRID * np.sqrt(spread[0] * spread[1]))

    whole = excess(np.ones(len(x), dtype=bool))
    left = np.array([excess(np.arange(len(x)) != g) for g in range(len(x))])
    error = np.sqrt((len(x) - 1) * left.var(axis=0))
    inside = GRID[np.abs(whole) <= student.ppf(0.975, len(x) - 1) * error]
    return (float(inside[0]), float(inside[-1])) if len(inside) else (1.0, -1.0)


OTHERS: dict[str, Callable[[Study, int], Ends]] = {
    "Fisher": fisher, "jackknife": jackknife, "Fieller": fieller,
}  # fmt: skip


def main() -> None:
    """Measure, print and store."""
    began = time.process_time()
    rows: dict[str, dict[str, list[float]]] = {}
    cells: list[dict[str, object]] = []
    for name in TRUTHS:
        r, bias = population(name)
        found = rows.setdefault(name, {})
        for groups, trials, factor in product(NUM_GROUPS, NUM_TRIALS, SIM_FACTORS):
            study = studies(name, groups, trials, factor, DRAWS)
            held = []
            for at in range(DRAWS):
                ends, of_bias = of_model(study, at, name in CROSSED, groups)
                held.append(ends[0] - NEAR <= r <= ends[1] + NEAR)
                for method, (low, high) in {
                    "model": ends, **{m: make(study, at) for m, make in OTHERS.items()}
                }.items():  # fmt: skip
                    found.setdefault(f"{method} r", []).append(low - NEAR <= r <= high + NEAR)
                    found.setdefault(f"{method} width", []).append(high - low)
                found.setdefault("model bias", []).append(of_bias[0] <= bias <= of_bias[1])
            cells.append(
                {"cell": [name, groups, trials, factor], "r": round(float(np.mean(held)), 3)}
            )
        shown = {key: round(float(np.mean(values)), 3) for key, values in found.items()}
        print(f"{name:28} {shown}", flush=True)
    table = {
        name: {key: round(float(np.mean(values)), 4) for key, values in found.items()}
        for name, found in rows.items()
    }
    covering = {
        method: float(np.mean([row[f"{method} width"] for row in table.values()]))
        for method in OTHERS
        if min(row[f"{method} r"] for row in table.values()) >= 0.93
    }
    width = float(np.mean([row["model width"] for row in table.values()]))
    narrow = [
        Target(
            what="mean width over the narrowest other method that covers 93 %",
            measured=width / least,
            limit=1.15,
        )
        for least in sorted(covering.values())[:1]
    ]
    report_targets(
        "evaluate_model",
        [
            Target(
                what="least coverage of r over truths",
                measured=min(row["model r"] for row in table.values()),
                limit=0.93,
                at_most=False,
            ),
            Target(
                what="least coverage of bias over truths",
                measured=min(row["model bias"] for row in table.values()),
                limit=0.93,
                at_most=False,
            ),
            *narrow,
        ],
        note=f"{DRAWS} studies of each of {len(cells)} cells; others that cover: "
        f"{', '.join(covering) or 'none'}",
        cpu_seconds=round(time.process_time() - began, 1),
        mean_width=round(width, 3),
        truths=table,
        cells=cells,
    )


if __name__ == "__main__":
    main()
