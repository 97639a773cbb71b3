"""Does the model of agreement cover? On the truths of ``agreement_truths.py``, fixed beforehand.

``MODEL_DRAWS`` (2) sets the draws of each truth, number of groups and number of trials, and
``MODEL_FIRST_DRAW`` (0) where they begin: other draws are other studies of the same truths. Both
sides are unpaired, the twin has as many trials or ten times as many. Few draws of one combination
say little; many combinations together do.
"""

import os
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from agreement_truths import FEWEST_CLUSTERED, NUM_GROUPS, NUM_TRIALS, SIM_FACTORS, TRUTHS, Truth
from measure import ROOT, Target, report_targets

from evaluator.statistics.group_likelihood import GroupCounts
from evaluator.statistics.hierarchical import AgreementModel

FULL_DRAWS = 2
DRAWS = int(os.environ.get("MODEL_DRAWS", FULL_DRAWS))
FIRST_DRAW = int(os.environ.get("MODEL_FIRST_DRAW", "0"))
NODES, NODES_IN_TASKS = 2048, 1024
"""Fewer than the evaluator uses (16,384, 8192): the ends of intervals move by some hundredths."""
WHOLE = 1.98
"""Width of r from which on an interval says nothing."""
LOG = "MODEL_LOG" in os.environ
if DRAWS != FULL_DRAWS or FIRST_DRAW:
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One simulated study and what the model said of it."""

    truth: Truth
    num_groups: int
    num_trials: int
    holds_r: bool
    holds_bias: bool
    width: float


def shots() -> Iterator[Shot]:
    """Draw studies, fit the model, and compare its intervals with the population."""
    known = [truth.population() for truth in TRUTHS]
    for draw in range(FIRST_DRAW, FIRST_DRAW + DRAWS):
        for number, (truth, (r, bias)) in enumerate(zip(TRUTHS, known, strict=True)):
            for num_groups in NUM_GROUPS:
                if truth.clustered and num_groups < FEWEST_CLUSTERED:
                    continue
                for num_trials in NUM_TRIALS:
                    rng = np.random.default_rng([number, num_groups, num_trials, draw])
                    factor = SIM_FACTORS[(draw + num_groups) % len(SIM_FACTORS)]
                    model = fit(truth, num_groups, (num_trials, num_trials * factor), rng)
                    found, gap = model.pearson_others, model.bias_others
                    yield Shot(
                        truth=truth,
                        num_groups=num_groups,
                        num_trials=num_trials,
                        holds_r=found.low <= r <= found.high,
                        holds_bias=gap.low <= bias <= gap.high,
                        width=found.high - found.low,
                    )


def fit(
    truth: Truth, num_groups: int, trials: tuple[int, int], rng: np.random.Generator
) -> AgreementModel:
    """Draw one study of a truth, and fit the model."""
    rates = truth.draw(num_groups, rng)
    counts = [rng.binomial(n, rates[:, side]) for side, n in enumerate(trials)]
    groups = [
        GroupCounts(
            recorded=(int(counts[0][g]), trials[0]), sim=(int(counts[1][g]), trials[1]), task=str(t)
        )
        for g, t in enumerate(truth.tasks(num_groups))
    ]
    return AgreementModel(groups, num_nodes=NODES_IN_TASKS if truth.clustered else NODES)


def covered(kept: list[Shot]) -> dict[str, float]:
    """Share of studies whose intervals hold the truth."""
    return {
        "studies": len(kept),
        "r": round(float(np.mean([shot.holds_r for shot in kept])), 4),
        "bias": round(float(np.mean([shot.holds_bias for shot in kept])), 4),
        "median width of r": round(float(np.median([shot.width for shot in kept])), 3),
        "whole range": sum(shot.width >= WHOLE for shot in kept),
    }


def main() -> None:
    """Measure, print and store."""
    began = time.process_time()
    found = []
    for shot in shots():
        found.append(shot)
        if LOG:
            print(asdict(shot), flush=True)
    seconds = time.process_time() - began
    by: dict[str, dict[str, list[Shot]]] = defaultdict(lambda: defaultdict(list))
    for shot in found:
        by["truth"][shot.truth.name].append(shot)
        by["trials"][f"{shot.num_trials:02d}"].append(shot)
        if not shot.truth.clustered:
            by["groups"][f"{shot.num_groups:02d}"].append(shot)
    tables = {
        axis: {name: covered(kept) for name, kept in named.items()} for axis, named in by.items()
    }
    for axis, rows in tables.items():
        for name, row in rows.items():
            print(f"  {axis:7} {name:32} {row}")
    whole = sum(s.width >= WHOLE for s in found if s.num_groups >= 5 and s.num_trials >= 10)
    widths = [row["median width of r"] for _, row in sorted(tables["groups"].items())]
    report_targets(
        "evaluate_model",
        [
            Target(
                what="least coverage of r over truths",
                measured=min(r["r"] for r in tables["truth"].values()),
                limit=0.93,
                at_most=False,
            ),
            Target(
                what="least coverage of bias over truths",
                measured=min(r["bias"] for r in tables["truth"].values()),
                limit=0.93,
                at_most=False,
            ),
            Target(
                what="coverage of r, all truths",
                measured=covered(found)["r"],
                limit=0.93,
                at_most=False,
            ),
            Target(
                what="coverage of bias, all truths",
                measured=covered(found)["bias"],
                limit=0.93,
                at_most=False,
            ),
            Target(
                what="coverage of r where groups share tasks",
                measured=covered([shot for shot in found if shot.truth.clustered])["r"],
                limit=0.93,
                at_most=False,
            ),
            Target(
                what="intervals as wide as the range, >= 5 groups of >= 10", measured=whole, limit=0
            ),
            Target(
                what="largest growth of the median width as groups are added",
                measured=float(np.diff(widths).max()),
                limit=0.0,
            ),
        ],
        note=f"{len(found)} simulated studies, {NODES} nodes ({NODES_IN_TASKS} by task)",
        cpu_seconds=round(seconds, 1),
        coverage=tables,
    )


if __name__ == "__main__":
    main()
