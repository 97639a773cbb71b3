"""What a twin saves and how well it forecasts, on twins whose worth is known. Fixed beforehand.

A useless twin (a constant, a coin, one that says the opposite) must save no trial in 95 % of the
studies. Intervals of the Brier score and the calibration error must hold what is true of the
forecaster. ``SAVINGS_DRAWS`` (400) sets the studies of each combination.
"""

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets

from evaluator.statistics.calibration import brier_interval, calibration_error_interval
from evaluator.statistics.gate import Confusion
from evaluator.statistics.prediction_powered import trials_saved

FULL_DRAWS = 400
DRAWS = int(os.environ.get("SAVINGS_DRAWS", FULL_DRAWS))
RATES = (0.1, 0.3, 0.5, 0.8, 0.95)
ROBOT_TRIALS = (5, 10, 20, 50, 100)
TWIN_STARTS = 200
if DRAWS != FULL_DRAWS:
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))

Answers = Callable[[np.ndarray, float, np.random.Generator], np.ndarray]
USELESS: dict[str, Answers] = {
    "always yes": lambda y, rate, rng: np.ones_like(y),
    "always no": lambda y, rate, rng: np.zeros_like(y),
    "coin": lambda y, rate, rng: rng.random(len(y)) < 0.5,
    "coin with the robot's rate": lambda y, rate, rng: rng.random(len(y)) < rate,
    "the opposite": lambda y, rate, rng: ~y,
    "the opposite in 7 of 10": lambda y, rate, rng: y ^ (rng.random(len(y)) < 0.7),
}
USEFUL: dict[str, Answers] = {
    "right in 8 of 10": lambda y, rate, rng: y ^ (rng.random(len(y)) < 0.2),
    "right in 19 of 20": lambda y, rate, rng: y ^ (rng.random(len(y)) < 0.05),
}
"""What a twin says, from the robot's outcomes and its rate."""
FORECASTERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "perfect": lambda p: p,
    "too sure": lambda p: np.clip(0.5 + 1.8 * (p - 0.5), 0.02, 0.98),
    "too optimistic": lambda p: np.clip(p + 0.2, 0.0, 1.0),
}
"""What is stated, from the true probabilities."""
FORECAST_TRIALS = (10, 20, 50, 100)
SAMPLES = 8
"""Stated probabilities are shares of so many varied replays."""


def savings(answers: Answers, rate: float, n: int, rng: np.random.Generator) -> list[int]:
    """Return the trials that the twin is said to save, in each study."""
    found = []
    for _ in range(DRAWS):
        y = rng.random(n + TWIN_STARTS) < rate
        said = answers(y, rate, rng).astype(bool)
        counts = Confusion.count(zip(said[:n].tolist(), y[:n].tolist(), strict=True))
        found.append(trials_saved(counts, int(said[n:].sum()), TWIN_STARTS))
    return found


def forecasts(state: Callable[[np.ndarray], np.ndarray], n: int, rng: np.random.Generator) -> Any:
    """Return how often both intervals hold what is true of these trials."""
    holds = [0, 0]
    for _ in range(DRAWS):
        true = rng.beta(1.0, 0.7, n)
        stated = np.round(SAMPLES * state(true)) / SAMPLES
        if state is FORECASTERS["perfect"]:
            true = stated
        happened = rng.random(n) < true
        expected = true * (1 - stated) ** 2 + (1 - true) * stated**2
        found = brier_interval(stated.tolist(), happened.tolist())
        holds[0] += int(found.low <= float(expected.mean()) <= found.high)
        places = np.minimum((stated * 10).astype(int), 9)
        error = sum(abs((stated - true)[places == b].sum()) for b in np.unique(places)) / n
        kept = calibration_error_interval(stated.tolist(), happened.tolist())
        holds[1] += int(kept.low - 1e-9 <= error <= kept.high + 1e-9)
    return {"brier": holds[0] / DRAWS, "ece": holds[1] / DRAWS}


def main() -> None:
    """Measure, print and store."""
    began = time.process_time()
    useless: dict[str, float] = {}
    useful: dict[str, Any] = {}
    for number, (name, answers) in enumerate({**USELESS, **USEFUL}.items()):
        for rate in RATES:
            for n in ROBOT_TRIALS:
                rng = np.random.default_rng([number, int(100 * rate), n])
                found = savings(answers, rate, n, rng)
                key = f"{name}, rate {rate:g}, {n} trials"
                if name in USELESS:
                    useless[key] = float(np.mean([saved == 0 for saved in found]))
                else:
                    useful[key] = [float(x) for x in np.percentile(found, (10, 50, 90))]
    kept = {
        f"{name}, {n} trials": forecasts(state, n, np.random.default_rng([99, place, n]))
        for place, (name, state) in enumerate(FORECASTERS.items())
        for n in FORECAST_TRIALS
    }
    worst = min(useless, key=lambda key: useless[key])
    report_targets(
        "evaluate_savings",
        [
            Target(
                what="least share of studies in which a useless twin saves nothing",
                measured=useless[worst],
                limit=0.95,
                at_most=False,
                reference=worst,
            ),
            *(
                Target(
                    what=f"least coverage of the interval of {name}",
                    measured=min(row[name] for row in kept.values()),
                    limit=0.93,
                    at_most=False,
                )
                for name in ("brier", "ece")
            ),
        ],
        note=f"{DRAWS} studies of each of {len(useless) + len(useful) + len(kept)} combinations",
        cpu_seconds=round(time.process_time() - began, 1),
        saves_nothing=useless,
        useful_saves_p10_p50_p90=useful,
        forecasts=kept,
    )


if __name__ == "__main__":
    main()
