"""Make the coverage map of every interval, and compare it with the one the package ships.

``COVERAGE_WRITE=1`` replaces the shipped map. ``COVERAGE_DRAWS`` (200) sets the draws of the
simulated methods; ``COVERAGE_METHODS=tango,jeffreys`` picks some.
"""

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets

FULL_DRAWS = 200
DRAWS = int(os.environ.get("COVERAGE_DRAWS", FULL_DRAWS))
CHOSEN = [name for name in os.environ.get("COVERAGE_METHODS", "").split(",") if name]
if DRAWS != FULL_DRAWS or CHOSEN:  # a number that proves nothing does not replace one that does
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))

from evaluator.statistics import (  # noqa: E402  # noqa: E402
    bootstrap,
    correlation,
    paired,
    proportion,
    proxy,
    sequential,
    unpaired,
)
from evaluator.statistics.coverage import exact, simulate, stored  # noqa: E402

SHIPPED = ROOT / "evaluator" / "statistics" / "coverage" / stored.MAP
SEED = 7
ALL_N = list(range(1, 101))
SOME_N = [*range(1, 21), 25, 30, 40, 50, 75, 100]
CELLS = [4, 5, 6, 8, 10, 15, 20, 50]
CLUSTERS = [4, 5, 6, 8, 10, 15, 20, 50]
BANDS = [3, 4, 6, 10, 20, 50]
PAIRS = [5, 10, 20, 40, 100]
PPI_PAIRS = [100, 200, 400]
RATES = "p = 0.05, 0.06 .. 0.95"
TWO_RATES = "both p = 0.05, 0.10 .. 0.95"
POPULATIONS = "r = 0, 0.5, 0.9 of the cells' true rates (0.05 to 0.95), 10 and 50 trials per cell"
CLUSTERED = f"{POPULATIONS}; policies of 3 cells that share half of the variance"
TWINS = "p = 0.05 .. 0.95, four twins from good to useless, 10 starts in the twin per robot trial"


def entry(how: str, over: str, axis: str, points: Sequence[exact.Coverage]) -> dict[str, Any]:
    rounded = [
        asdict(point) | {"worst": round(point.worst, 6), "mean": round(point.mean, 6)}
        for point in points
    ]
    return {"how": how, "over": over, "axis": axis, "points": rounded}


def exact_methods() -> dict[str, Callable[[], dict[str, Any]]]:
    def rates(method: Callable[..., Any]) -> dict[str, Any]:
        return entry("exact", RATES, "trials", [exact.of_rate(method, n) for n in ALL_N])

    def differences(method: Callable[..., Any]) -> dict[str, Any]:
        points = [exact.of_difference(method, n) for n in SOME_N]
        return entry("exact", TWO_RATES, "trials per group", points)

    def pairs(method: Callable[..., Any]) -> dict[str, Any]:
        points = [exact.of_paired_difference(method, n) for n in SOME_N]
        return entry("exact", TWO_RATES, "pairs", points)

    return {
        "wilson": partial(rates, proportion.wilson),
        "clopper-pearson": partial(rates, proportion.clopper_pearson),
        "jeffreys": partial(rates, proportion.jeffreys),
        "betting": partial(rates, sequential.betting_interval),
        "newcombe-10": partial(differences, unpaired.newcombe_difference),
        "clopper-pearson-difference": partial(differences, unpaired.guaranteed_difference),
        "tango": partial(pairs, paired.tango_difference),
    }


def simulated_methods() -> dict[str, Callable[[], dict[str, Any]]]:
    how = f"simulated, {DRAWS} draws of each truth, 5 times as many again of the worst"

    def cells(
        make: Callable[..., Any], statistic: str, sizes: Sequence[int], *, clustered: bool
    ) -> dict[str, Any]:
        rng = np.random.default_rng(SEED)
        populations = simulate.CLUSTERED if clustered else simulate.POPULATIONS
        points = [
            simulate.of_cells(make, statistic, n, populations, draws=DRAWS, rng=rng) for n in sizes
        ]
        over, axis = (CLUSTERED, "policies") if clustered else (POPULATIONS, "cells")
        return entry(how, over, axis, points)

    def proxies(make: Callable[..., Any], sizes: Sequence[int]) -> dict[str, Any]:
        rng = np.random.default_rng(SEED)
        points = [simulate.of_proxy(make, n, draws=DRAWS, rng=rng) for n in sizes]
        return entry(how, TWINS, "robot trials", points)

    def bands() -> dict[str, Any]:
        rng = np.random.default_rng(SEED)
        kind = simulate.POPULATIONS
        points = [
            simulate.of_remeasurement(remeasured, n, kind, draws=DRAWS, rng=rng) for n in BANDS
        ]
        return entry(how, f"r of a second measurement; {POPULATIONS}", "cells", points)

    methods: dict[str, Callable[[], dict[str, Any]]] = {
        "remeasurement": bands,
        "fisher-z": partial(cells, fisher, "pearson", CELLS, clustered=False),
        "student-t:bias": partial(cells, student, "bias", CELLS, clustered=False),
        "student-t:cluster-bias": partial(cells, student, "bias", CLUSTERS, clustered=True),
        "post-stratified-beta": partial(proxies, post_stratified, PAIRS),
        "ppi++": partial(proxies, ppi, PPI_PAIRS),
    }
    for statistic in ("pearson", "bias"):
        for kind, sizes, clustered in (("points", CELLS, False), ("clusters", CLUSTERS, True)):
            methods[f"bootstrap-{kind}:{statistic}"] = partial(
                cells, resampled(statistic), statistic, sizes, clustered=clustered
            )
    return methods


def remeasured(cells: simulate.Cells, trials: int, rng: np.random.Generator) -> Any:
    recorded, sim = ([(int(k), trials) for k in side] for side in cells)
    return bootstrap.remeasurement_band_of_counts(recorded, sim, rng=rng, num_draws=500)


def fisher(cells: simulate.Cells, per_cluster: int, rng: np.random.Generator) -> Any:
    return correlation.fisher_interval(correlation.pearson(*cells), len(cells[0]))


def student(cells: simulate.Cells, per_cluster: int, rng: np.random.Generator) -> Any:
    gaps = np.subtract(cells[1], cells[0]).reshape(-1, per_cluster)
    return bootstrap.student_interval(gaps.mean(axis=1).tolist())


def resampled(statistic: str) -> Callable[..., Any]:
    def make(cells: simulate.Cells, per_cluster: int, rng: np.random.Generator) -> Any:
        clusters = [i // per_cluster for i in range(len(cells[0]))]
        return bootstrap.bootstrap_interval(
            statistic,
            recorded=cells[0],
            sim=cells[1],
            rng=rng,
            clusters=None if per_cluster == 1 else clusters,
            max_exact=2_000,
            num_resamples=999,
        )

    return make


def post_stratified(pairs: Any, sim_k: int, sim_n: int) -> Any:
    return proxy.post_stratified(pairs, sim_k, sim_n).interval


def ppi(pairs: Any, sim_k: int, sim_n: int) -> Any:
    real = [True] * pairs.true_positive + [False] * pairs.false_positive
    real += [True] * pairs.false_negative + [False] * pairs.true_negative
    said = [1.0] * pairs.said_success + [0.0] * pairs.said_failure
    alone = [1.0] * sim_k + [0.0] * (sim_n - sim_k)
    return proxy.ppi_plus_plus(real, said, alone).interval


def main() -> None:
    """Make the map, print the worst cases, compare, and perhaps store it."""
    shipped = json.loads(SHIPPED.read_text())["methods"] if SHIPPED.is_file() else {}
    made = dict(shipped) if CHOSEN else {}
    worst_change, seconds = 0.0, {}
    for name, make in {**exact_methods(), **simulated_methods()}.items():
        if CHOSEN and name not in CHOSEN:
            continue
        start_s = time.perf_counter()
        made[name] = make()
        seconds[name] = time.perf_counter() - start_s
        points = made[name]["points"]
        worst = min(points, key=lambda point: point["worst"])
        print(
            f"  {name:<28} worst {worst['worst']:.3f} at n = {worst['n']} ({worst['worst_at']}); "
            f"refused below 0.90 at n = {[p['n'] for p in points if p['worst'] < stored.FLOOR]}"
            f"  {seconds[name]:.1f} s"
        )
        if made[name]["how"] == "exact" and name in shipped:
            pairs = zip(points, shipped[name]["points"], strict=False)
            worst_change = max(worst_change, *(abs(a["worst"] - b["worst"]) for a, b in pairs))
    if os.environ.get("COVERAGE_WRITE"):
        text = json.dumps({"level": 0.95, "seed": SEED, "methods": made}, indent=0)
        SHIPPED.write_text(text + "\n")
    if CHOSEN:
        return
    wilson = [p for p in made["wilson"]["points"] if p["n"] >= 5]
    exact_ends = [p for p in made["clopper-pearson"]["points"] if p["n"] >= 5]
    report_targets(
        "evaluate_coverage",
        [
            Target(
                what="Clopper-Pearson, worst coverage, n = 5..100",
                measured=min(p["worst"] for p in exact_ends),
                limit=0.95,
                at_most=False,
            ),
            Target(
                what="Wilson, smallest mean over p, n = 5..100",
                measured=min(p["mean"] for p in wilson),
                limit=0.945,
                at_most=False,
                reference=f"its minimum over p: {min(p['worst'] for p in wilson):.4f}",
            ),
            Target(
                what="shipped map differs from this one (exact methods)",
                measured=worst_change,
                limit=1e-6,
            ),
        ],
        note=f"95 % intervals; simulated methods with {DRAWS} draws of each truth",
        seconds=seconds,
    )


if __name__ == "__main__":
    main()
