"""Compute how far simulation and reality agree, from the trials of a run that was evaluated.

Run: python examples/agreement.py runs/demo
"""

import sys
from pathlib import Path

from pandas import read_parquet

from evaluator.statistics import agreement
from evaluator.statistics.intervals import wilson


def main(run: Path) -> None:
    """Print agreement trial by trial, and the rates of each group."""
    trials = read_parquet(run / "results" / "trials.parquet")
    trials = trials.dropna(subset=["recorded", "sim_planned"]).astype({"recorded": bool})
    agree = trials["recorded"] == trials["sim_planned"]
    interval = wilson(int(agree.sum()), len(agree))
    ends = f"[{interval.low:.3f}, {interval.high:.3f}] ({interval.method})"
    print(f"sim and outcome agree: {agree.sum()}/{len(agree)} = {agree.mean():.3f} {ends}")
    rates = trials.groupby(["task", "condition"])[["recorded", "sim_planned"]].mean()
    print(rates.to_string())
    recorded, sim = rates["recorded"].tolist(), rates["sim_planned"].tolist()
    print(f"bias (sim - recorded): {100 * agreement.bias(recorded=recorded, sim=sim):+.1f} pp")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
