"""Make the coverage map of every interval, and compare it with the one the package ships.

``COVERAGE_WRITE=1`` replaces the shipped map. ``COVERAGE_DRAWS`` (200) sets the draws of the
simulated methods; ``COVERAGE_METHODS=tango,jeffreys,groups`` picks some: ``groups``, ``policies``
and ``remeasurement`` stand for every statistic of agreement.
"""

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import coverage_drawn as simulate
import coverage_exact as exact
import numpy as np
from measure import ROOT, Target, report_targets

FULL_DRAWS = 200
DRAWS = int(os.environ.get("COVERAGE_DRAWS", FULL_DRAWS))
CHOSEN = [name for name in os.environ.get("COVERAGE_METHODS", "").split(",") if name]
if DRAWS != FULL_DRAWS or CHOSEN:  # a number that proves nothing does not replace one that does
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))

from coverage_drawn import (  # noqa: E402
    CLUSTERED,
    POPULATIONS,
    of_agreement,
    of_remeasurements,
)

from evaluator.statistics import agreement as agreement_module  # noqa: E402
from evaluator.statistics import bootstrap, intervals, prediction_powered, sequential  # noqa: E402
from evaluator.statistics import coverage as stored  # noqa: E402
from evaluator.statistics import differences as differences_module  # noqa: E402
from evaluator.statistics.weighted import STATISTICS  # noqa: E402

SHIPPED = ROOT / "evaluator" / "statistics" / stored.MAP
SEED = 7
ALL_N = list(range(1, 101))
SOME_N = [*range(1, 21), 25, 30, 40, 50, 75, 100]
GROUPS = [4, 6, 8, 10, 15, 20, 50]
CLUSTERS = [4, 6, 8, 10, 15, 20, 40]
BANDS = [3, 4, 6, 10, 20, 50]
PAIRS = [5, 10, 20, 40, 100]
PPI_PAIRS = [100, 200, 400]
LENGTHS = [3, 4, 5, 6, 8, 10, 15, 20, 30, 50, 100, 200]
RATES = "p = 0.05, 0.06 .. 0.95"
TWO_RATES = "both p = 0.05, 0.10 .. 0.95"
OVER_GROUPS = "r = 0, 0.5, 0.9 of the groups' true rates (0.05 to 0.95), 10 and 50 trials per group"
OVER_CLUSTERED = f"{OVER_GROUPS}; policies of 3 groups that share half of the variance"
TWINS = "p = 0.05 .. 0.95, four twins from good to useless, 10 starts in the twin per robot trial"


def entry(how: str, over: str, axis: str, points: Sequence[stored.Coverage]) -> dict[str, Any]:
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

    def medians() -> dict[str, Any]:
        points = [exact.of_median(n) for n in ALL_N if n >= 6]
        return entry("exact", "any continuous distribution", "values", points)

    return {
        "wilson": partial(rates, intervals.wilson),
        "clopper-pearson": partial(rates, intervals.clopper_pearson),
        "jeffreys": partial(rates, intervals.jeffreys),
        "betting": partial(rates, sequential.betting_interval),
        "newcombe-10": partial(differences, differences_module.newcombe_difference),
        "clopper-pearson-difference": partial(
            differences, differences_module.guaranteed_difference
        ),
        "tango": partial(pairs, differences_module.tango_difference),
        "order-statistics": medians,
    }


def simulated_methods() -> dict[str, Callable[[], dict[str, Any]]]:
    how = f"simulated, {DRAWS} draws of each truth, 5 times as many again of the worst"

    def groups(
        make: Callable[..., Any], statistic: str, sizes: Sequence[int], *, clustered: bool
    ) -> dict[str, Any]:
        rng = np.random.default_rng(SEED)
        populations = CLUSTERED if clustered else POPULATIONS
        points = [
            simulate.of_groups(make, statistic, n, populations, draws=DRAWS, rng=rng) for n in sizes
        ]
        over, axis = (OVER_CLUSTERED, "policies") if clustered else (OVER_GROUPS, "groups")
        return entry(how, over, axis, points)

    def proxies(make: Callable[..., Any], sizes: Sequence[int]) -> dict[str, Any]:
        rng = np.random.default_rng(SEED)
        points = [simulate.of_proxy(make, n, draws=DRAWS, rng=rng) for n in sizes]
        return entry(how, TWINS, "robot trials", points)

    def means() -> dict[str, Any]:
        rng = np.random.default_rng(SEED)
        make, draws = bootstrap.student_interval, 10 * DRAWS
        points = [exact.of_mean(make, n, draws=draws, rng=rng) for n in LENGTHS]
        over = "; ".join(population.name for population in exact.POPULATIONS)
        return entry(f"simulated, {draws} draws of each distribution", over, "values", points)

    return {
        "fisher-z": partial(groups, fisher, "pearson", GROUPS, clustered=False),
        "student-t:bias": partial(groups, student, "bias", GROUPS, clustered=False),
        "student-t:cluster-bias": partial(groups, student, "bias", CLUSTERS, clustered=True),
        "post-stratified-beta": partial(proxies, post_stratified, PAIRS),
        "ppi++": partial(proxies, ppi, PPI_PAIRS),
        "student-t:length": means,
    }


def families() -> dict[str, Callable[[], dict[str, dict[str, Any]]]]:
    """Methods that are simulated together, because they share their draws."""
    draws = 2 * DRAWS  # the least of several truths is too low by their noise
    how = f"simulated, {draws} draws of each truth"

    def agreement(sizes: Sequence[int], *, clustered: bool) -> dict[str, dict[str, Any]]:
        rng = np.random.default_rng(SEED)
        populations = CLUSTERED if clustered else POPULATIONS
        found = [of_agreement(n, populations, draws=draws, rng=rng) for n in sizes]
        over, axis = (OVER_CLUSTERED, "policies") if clustered else (OVER_GROUPS, "groups")
        return by_method(found, over, axis)

    def bands() -> dict[str, dict[str, Any]]:
        rng = np.random.default_rng(SEED)
        found = [of_remeasurements(n, POPULATIONS, draws=draws, rng=rng) for n in BANDS]
        return by_method(found, f"the statistic of a second measurement; {OVER_GROUPS}", "groups")

    def by_method(
        found: Sequence[dict[str, stored.Coverage]], over: str, axis: str
    ) -> dict[str, dict[str, Any]]:
        return {name: entry(how, over, axis, [sizes[name] for sizes in found]) for name in found[0]}

    return {
        "remeasurement": bands,
        "groups": partial(agreement, GROUPS, clustered=False),
        "policies": partial(agreement, CLUSTERS, clustered=True),
    }


def fisher(groups: simulate.Groups, per_cluster: int, rng: np.random.Generator) -> Any:
    return agreement_module.fisher_interval(agreement_module.pearson(*groups), len(groups[0]))


def student(groups: simulate.Groups, per_cluster: int, rng: np.random.Generator) -> Any:
    gaps = np.subtract(groups[1], groups[0]).reshape(-1, per_cluster)
    return bootstrap.student_interval(gaps.mean(axis=1).tolist())


def post_stratified(pairs: Any, sim_k: int, sim_n: int) -> Any:
    return prediction_powered.post_stratified(pairs, sim_k, sim_n).interval


def ppi(pairs: Any, sim_k: int, sim_n: int) -> Any:
    real = [True] * pairs.true_positive + [False] * pairs.false_positive
    real += [True] * pairs.false_negative + [False] * pairs.true_negative
    said = [1.0] * pairs.predicted_success + [0.0] * pairs.predicted_failure
    alone = [1.0] * sim_k + [0.0] * (sim_n - sim_k)
    return prediction_powered.ppi_plus_plus(real, said, alone).interval


def everything() -> dict[str, Callable[[], dict[str, dict[str, Any]]]]:
    """What can be chosen, and the methods each makes."""

    def alone(name: str, make: Callable[[], dict[str, Any]]) -> dict[str, dict[str, Any]]:
        return {name: make()}

    single = {**exact_methods(), **simulated_methods()}
    return {**{name: partial(alone, name, make) for name, make in single.items()}, **families()}


def show(name: str, points: Sequence[dict[str, Any]]) -> None:
    worst = min(points, key=lambda point: point["worst"])
    print(
        f"  {name:<40} worst {worst['worst']:.3f} at n = {worst['n']} ({worst['worst_at']}); "
        f"refused below 0.90 at n = {[p['n'] for p in points if p['worst'] < stored.FLOOR]}"
    )


def change(made: dict[str, Any], shipped: dict[str, Any]) -> float:
    """Largest difference of a worst coverage that is counted out, not drawn."""
    pairs = zip(made["points"], shipped["points"], strict=False)
    return max(abs(a["worst"] - b["worst"]) for a, b in pairs)


def store(made: dict[str, dict[str, Any]]) -> None:
    """Put methods into the shipped map, one line for each; the others stay."""
    held = json.loads(SHIPPED.read_text())["methods"] if CHOSEN and SHIPPED.is_file() else {}
    lines = [f"{json.dumps(name)}: {json.dumps(item)}" for name, item in (held | made).items()]
    start = f'{{\n"level": 0.95,\n"seed": {SEED},\n"methods": {{\n'
    SHIPPED.write_text(start + ",\n".join(lines) + "\n}\n}\n")


def main() -> None:
    """Make the map, print the worst cases, compare, and perhaps store it."""
    shipped = json.loads(SHIPPED.read_text())["methods"] if SHIPPED.is_file() else {}
    made: dict[str, dict[str, Any]] = {}
    worst_change, seconds = 0.0, {}
    for name, make in everything().items():
        if CHOSEN and name not in CHOSEN:
            continue
        start_s = time.perf_counter()
        found = make()
        seconds[name] = time.perf_counter() - start_s
        made |= found
        for method, item in found.items():
            show(method, item["points"])
            if item["how"] == "exact" and method in shipped:
                worst_change = max(worst_change, change(item, shipped[method]))
        print(f"  {name}: {seconds[name]:.1f} s", flush=True)
    if os.environ.get("COVERAGE_WRITE"):
        store(made)
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
            Target(
                what="statistics of agreement without a method that holds at 20 groups",
                measured=float(unheld(made, "points", 20)),
                limit=0.0,
            ),
        ],
        note=f"95 % intervals; simulated methods with {DRAWS} draws of each truth",
        seconds=seconds,
    )


def unheld(made: dict[str, dict[str, Any]], kind: str, n: int) -> int:
    """Count the statistics that no method covers with 90 % at n."""

    def holds(statistic: str) -> bool:
        keys = [f"{method}-{kind}:{statistic}" for method in bootstrap.METHODS]
        points = [p for key in keys for p in made[key]["points"] if p["n"] == n]
        return any(point["worst"] >= stored.FLOOR for point in points)

    return sum(not holds(statistic) for statistic in STATISTICS)


if __name__ == "__main__":
    main()
