"""Does a designed study get the interval and the power it was designed for? Fixed beforehand.

For each expectation a study is designed, then drawn ``DESIGN_DRAWS`` (400) times as it says, and
what the evaluator's own intervals and tests find is compared with what the design predicted.
"""

import os
import time
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets

from evaluator.design.config import StudyOptions, Wanted
from evaluator.design.plan import design
from evaluator.statistics.differences import sign_test, tango_difference
from evaluator.statistics.intervals import wilson
from evaluator.statistics.planning import paired_width, power_above, rate_width
from evaluator.statistics.power import power_paired

FULL_DRAWS = 400
DRAWS = int(os.environ.get("DESIGN_DRAWS", FULL_DRAWS))
if DRAWS != FULL_DRAWS:
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
EXPECTED = [
    (rate, gain, correlation, tasks)
    for rate in (0.2, 0.5, 0.7)
    for gain in (0.15, 0.25)
    for correlation in (0.0, 0.4)
    for tasks in (1, 4)
]
"""Rate, gain, correlation of both outcomes of a start, tasks."""
WIDTHS = (0.25, 0.4, 0.6)
"""Of the gain's interval that are asked for."""
AGREEMENT, LIMIT = 0.85, 0.7


def carried_out(
    rates: tuple[float, float], correlation: float, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw outcomes before and after (draws, starts) with these rates and correlation."""
    first, second = rates
    spread = np.sqrt(first * (1 - first) * second * (1 - second))
    both = np.clip(first * second + correlation * spread, max(0, first + second - 1), min(rates))
    before = rng.random((DRAWS, n)) < first
    given = np.where(before, both / first, (second - both) / (1 - first))
    return before, rng.random((DRAWS, n)) < given


def examined(number: int, width: float | None) -> dict[str, Any]:
    """Design a study for one expectation, carry it out, and set what was found beside it."""
    rate, gain, correlation, tasks = EXPECTED[number]
    made = design(
        StudyOptions(task=tuple(f"task_{k}" for k in range(tasks)), any_task=True),
        Wanted(
            rate=rate,
            gain=gain,
            correlation=correlation,
            width=width,
            power=0.8 if width is None else 0.05,
        ),
    )
    n, chances = tasks * made.protocol.tasks[0].starts, made.expected.chances()
    rng = np.random.default_rng([number, int(100 * (width or 0))])
    before, after = carried_out((rate, rate + gain), correlation, n, rng)
    counts = np.stack([(after & ~before).sum(axis=1), (before & ~after).sum(axis=1)], axis=1)
    intervals = [tango_difference(int(a), int(b), n) for a, b in counts]
    shown = [bool(a + b) and sign_test(int(a), int(b))[1] <= 0.05 for a, b in counts]
    ends = [wilson(int(k), n) for k in before.sum(axis=1)]
    agreed = rng.binomial(n, AGREEMENT, DRAWS)
    return {
        "expected": [rate, gain, correlation, tasks],
        "asked for": "80 % power" if width is None else f"width {width:g}",
        "pairs": n,
        "width": paired_width(*chances, n),
        "width achieved": float(np.mean([e.high - e.low for e in intervals])),
        "rate width": rate_width(rate, n),
        "rate width achieved": float(np.mean([e.high - e.low for e in ends])),
        "power": power_paired(*chances, n, mid=True),
        "power achieved": float(np.mean(shown)),
        "claim": power_above(AGREEMENT, LIMIT, n),
        "claim achieved": float(np.mean([wilson(int(k), n).low > LIMIT for k in agreed])),
    }


def targets(rows: list[dict[str, Any]]) -> list[Target]:
    """What was predicted against what was achieved, at its worst over all designs."""
    sized = [row for row in rows if row["asked for"] == "80 % power"]
    asked = [row for row in rows if row["asked for"] != "80 % power"]

    def ratio_off(name: str) -> float:
        return max(abs(row[f"{name} achieved"] / row[name] - 1) for row in rows)

    def off(name: str) -> float:
        return max(abs(row[f"{name} achieved"] - row[name]) for row in rows)

    widest = max(row["width achieved"] / float(row["asked for"].split()[1]) for row in asked)
    least = min(row["power achieved"] for row in sized)
    difference = "largest difference of predicted and achieved power"
    return [
        Target(
            what="predicted against achieved width, gain", measured=ratio_off("width"), limit=0.1
        ),
        Target(
            what="predicted against achieved width, rate",
            measured=ratio_off("rate width"),
            limit=0.1,
        ),
        Target(what="achieved width over the wanted one, largest", measured=widest, limit=1.1),
        Target(
            what="least power achieved where 80 % were asked for",
            measured=least,
            limit=0.75,
            at_most=False,
        ),
        Target(what=difference, measured=off("power"), limit=0.08),
        Target(what=f"{difference} of the claim", measured=off("claim"), limit=0.08),
    ]


def main() -> None:
    """Measure, print and store."""
    began = time.process_time()
    rows = [examined(number, w) for number in range(len(EXPECTED)) for w in (None, *WIDTHS)]
    report_targets(
        "evaluate_design",
        targets(rows),
        note=f"{len(rows)} designs, each carried out {DRAWS} times",
        cpu_seconds=round(time.process_time() - began, 1),
        designs=rows,
    )


if __name__ == "__main__":
    main()
