"""Compute how far simulation and reality agree, from the trials of a run or of a table.

Run: python examples/agreement.py runs/demo, or any CSV file of trials (docs/exchange.md)
"""

import sys
from pathlib import Path

import evaluator
from evaluator.statistics import agreement
from evaluator.statistics.intervals import wilson


def main(path: Path) -> None:
    """Print agreement trial by trial, and the rates of each group."""
    trials = evaluator.read_trials(path).dropna(subset=["recorded", "sim_planned"])
    agree = trials["recorded"] == trials["sim_planned"]
    interval = wilson(int(agree.sum()), len(agree))
    print(
        f"sim and outcome agree: {agree.sum()}/{len(agree)} = {agree.mean():.3f} "
        f"[{interval.low:.3f}, {interval.high:.3f}] ({interval.method})"
    )

    rates = trials.groupby(["task", "condition"])[["recorded", "sim_planned"]].mean()
    print(rates.to_string())
    recorded, sim = rates["recorded"].tolist(), rates["sim_planned"].tolist()
    print(f"bias (sim - recorded): {100 * agreement.bias(recorded=recorded, sim=sim):+.1f} pp")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
