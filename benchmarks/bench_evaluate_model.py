"""Does the model of agreement cover, and does it name the groups in which the twin is blind?

On the truths of ``agreement_truths.py``, fixed beforehand. ``MODEL_DRAWS`` (100) studies of each
truth, groups, trials and factor of the twin's trials. Success:

1. Least coverage over cells (truth, groups, trials: 200 studies) of r and of the bias at least
   93 %; mean width of r at most 1.15 of the narrowest other method that covers so: compared are
   Fisher's interval of the measured r, the jackknife on Fisher's scale, and Fieller's interval of
   the covariance without the noise of counting (jackknife).
2. Blind groups: three twins that are blind in a fifth of the groups and one that nowhere is, each
   also with tasks x policies, a fifth of the studies, seeds [3, twin, groups, trials, factor]. At
   least 80 % of the groups named are blind, with each twin and number of groups; of studies without
   a blind group at most 5 % name one; the share of blind groups lies in its interval in 93 %. Of
   blind groups whose true rates lie 40 points apart half are named with 28 groups.
"""

import os
import time
from collections.abc import Callable
from itertools import product

import numpy as np
from agreement_truths import (
    BLIND,
    CROSSED,
    NUM_GROUPS,
    NUM_TRIALS,
    SAID,
    SIM_FACTORS,
    TRUTHS,
    Counts,
    population,
    studies,
    with_blind,
)
from measure import ROOT, Target, report_targets
from scipy.stats import t as student

from evaluator.compare.agreement import LIKELY_BLIND
from evaluator.statistics import gap_model
from evaluator.statistics.gap_model import GapModel, GroupCounts

FULL_DRAWS = 100
OF_OTHERS = 20
"""Studies of each that other methods are asked about, too."""
DRAWS = int(os.environ.get("MODEL_DRAWS", FULL_DRAWS))
if DRAWS != FULL_DRAWS:
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
NEAR = 1e-3
"""The population's correlation is known to so much."""
Study = tuple[Counts, Counts, Counts, Counts]
Ends = tuple[float, float]


def groups_of(study: Study, at: int, crossed: bool, groups: int) -> tuple[GroupCounts, ...]:
    """What was counted in one study."""
    k, n, j, m = (side[at] for side in study)
    policies = NUM_GROUPS[groups][1]
    return tuple(
        GroupCounts(
            recorded=(int(k[g]), int(n[g])),
            sim=(int(j[g]), int(m[g])),
            shares=(f"task {g // policies}", f"policy {g % policies}") if crossed else (),
        )
        for g in range(groups)
    )


def model_of(study: Study, at: int, crossed: bool, groups: int) -> GapModel:
    """The model under test."""
    return GapModel(groups=groups_of(study, at, crossed, groups))


class Logs:
    """Logs of the chances of a cell's groups in each population, each kind of group once."""

    def __init__(self, study: Study) -> None:
        """Ask the model for them."""
        counts = np.stack(study, axis=-1)
        kinds, places = np.unique(counts.reshape(-1, 4), axis=0, return_inverse=True)
        self.places = places.reshape(counts.shape[:2])
        there = gap_model.drawn()
        share = there.share[:, None].astype(np.float32)
        self.found = np.empty((len(kinds), len(share)), dtype=np.float32)
        for start in range(0, len(kinds), 200):
            some = kinds[start : start + 200].tolist()
            groups = [GroupCounts(recorded=(k, n), sim=(j, m)) for k, n, j, m in some]
            tables = [gap_model._likelihood(group, 0.0) for group in groups]
            seeing, blind = gap_model.chances_in(there, tables)
            chance = np.maximum((1 - share) * seeing + share * blind, 1e-35)
            self.found[start : start + len(some)] = np.log(chance).T

    def model(self, study: Study, at: int, crossed: bool, groups: int) -> GapModel:
        """The model under test, with the weights that follow; the first one is made twice."""
        if not at:
            self.check(whole := model_of(study, at, crossed, groups), self.places[0])
            return whole
        made = object.__new__(GapModel)
        object.__setattr__(made, "groups", groups_of(study, at, crossed, groups))
        logs = self.found[self.places[at]].sum(axis=0, dtype=np.float64)
        object.__setattr__(made, "weights", gap_model._flattened(logs / made.design_effect))
        return made

    def check(self, whole: GapModel, places: np.ndarray) -> None:
        """End where the weights are not the model's own."""
        logs = self.found[places].sum(axis=0, dtype=np.float64)
        weights = gap_model._flattened(logs / whole.design_effect)
        np.testing.assert_allclose(weights, whole.weights, rtol=1e-2, atol=1e-6)


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
Cells = dict[tuple[str, int, int], dict[str, list[float]]]


def covering() -> Cells:
    """By cell: which intervals hold the truth, and how wide they are."""
    cells: Cells = {}
    for name in TRUTHS:
        r, bias = population(name)
        for groups, trials, factor in product(NUM_GROUPS, NUM_TRIALS, SIM_FACTORS):
            study = studies(name, groups, trials, factor, DRAWS)
            logs = Logs(study)
            found = cells.setdefault((name, groups, trials), {})
            for at in range(DRAWS):
                model = logs.model(study, at, name in CROSSED, groups)
                ends = {"model": (model.r.low, model.r.high)}
                if at < OF_OTHERS:
                    ends |= {method: make(study, at) for method, make in OTHERS.items()}
                for method, (low, high) in ends.items():
                    found.setdefault(method, []).append(low - NEAR <= r <= high + NEAR)
                    found.setdefault(f"{method} width", []).append(high - low)
                found.setdefault("bias", []).append(model.bias.low <= bias <= model.bias.high)
        mine = {
            cell[1:]: float(np.mean(each["model"]))
            for cell, each in cells.items()
            if cell[0] == name
        }
        print(f"{name:28} {mine}", flush=True)
    return cells


def naming() -> dict[str, dict[str, float | None]]:
    """By twin and number of groups: which groups are named, of blind and of other ones."""
    found: dict[str, dict[str, float | None]] = {}
    twins = product((False, True), [*SAID.items(), ("", SAID["yes"])])
    for (place, (crossed, (words, said))), groups in product(enumerate(twins), NUM_GROUPS):
        blind, far, others, right, studies_with, held = [], [], [], [], [], []
        share = BLIND if words else 0.0
        for trials, factor in product(NUM_TRIALS, SIM_FACTORS):
            rng = np.random.default_rng([3, place, groups, trials, factor])
            x, y, is_blind = with_blind(said, share, rng, (max(DRAWS // 5, 2), groups), crossed)
            n, m = np.full(x.shape, trials), np.full(x.shape, factor * trials)
            study = rng.binomial(n, x), n, rng.binomial(m, y), m
            for at in range(len(x)):
                model = model_of(study, at, crossed, groups)
                named = model.blind_groups >= LIKELY_BLIND
                blind += named[is_blind[at]].tolist()
                far += named[is_blind[at] & (np.abs(x[at] - y[at]) >= 0.4)].tolist()
                others += named[~is_blind[at]].tolist()
                right += is_blind[at][named].tolist()
                studies_with.append(named.any())
                interval = model.blind_share[1]
                held.append(interval.low - NEAR <= share <= interval.high + NEAR)
        parts = {"blind named": blind, "of 40 points and more": far, "others named": others,
                 "named are blind": right, "studies that name any": studies_with,
                 "share held": held}  # fmt: skip
        shown = {
            name: round(float(np.mean(each)), 4) if each else None for name, each in parts.items()
        }
        name = f"blind fifth says {words}, " if words else "none blind, "
        found[f"{name}{'tasks x policies, ' * crossed}{groups}"] = shown
        print(shown, flush=True)
    return found


def main() -> None:
    """Measure, print and store."""
    began = time.process_time()
    named = naming()
    cells = covering()
    table = [
        {"cell": list(cell), **{key: round(float(np.mean(each)), 3) for key, each in found.items()}}
        for cell, found in cells.items()
    ]

    def least(method: str) -> float:
        return min(float(np.mean(found[method])) for found in cells.values())

    widths = {
        method: float(np.mean([np.mean(found[f"{method} width"]) for found in cells.values()]))
        for method in ("model", *OTHERS)
    }
    covers = {method: least(method) for method in OTHERS}
    narrowest = min((widths[m] for m, held in covers.items() if held >= 0.93), default=None)
    none = {name: each for name, each in named.items() if name.startswith("none")}
    fifth = {name: each for name, each in named.items() if name not in none}
    targets = [
        _least("least coverage of r over cells", least("model"), 0.93),
        _least("least coverage of the bias over cells", least("bias"), 0.93),
        _least("least coverage of the share of blind groups",
               _extreme(min, named, "share held"), 0.93),
        _least("named groups that are blind, least of 18",
               _extreme(min, fifth, "named are blind"), 0.8),
        _least("blind groups of 40 points that are named, 28 groups, least of 6",
               _extreme(min, {n: e for n, e in fifth.items() if n.endswith(" 28")},
                        "of 40 points and more"), 0.5),
        _most("studies without a blind group that name one, most of 6",
              _extreme(max, none, "studies that name any"), 0.05),
    ]  # fmt: skip
    if narrowest is not None:
        targets.append(_most("mean width over the narrowest other method that covers",
                             widths["model"] / narrowest, 1.15))  # fmt: skip
    report_targets(
        "evaluate_model",
        targets,
        note=f"{len(SIM_FACTORS) * DRAWS} studies of each of {len(cells)} cells; least coverage of "
        f"others: {', '.join(f'{name} {held:.2f}' for name, held in covers.items())}",
        cpu_seconds=round(time.process_time() - began, 1),
        mean_widths={name: round(width, 3) for name, width in widths.items()},
        blind=named,
        cells=table,
    )


def _extreme(
    most: Callable[[list[float]], float], rows: dict[str, dict[str, float | None]], what: str
) -> float:
    return most([value for each in rows.values() if (value := each[what]) is not None])


def _least(what: str, measured: float, limit: float) -> Target:
    return Target(what=what, measured=measured, limit=limit, at_most=False)


def _most(what: str, measured: float, limit: float) -> Target:
    return Target(what=what, measured=measured, limit=limit)


if __name__ == "__main__":
    main()
