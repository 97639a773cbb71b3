"""Compute how far simulation and reality agree, from a table of trials.

Run: python examples/agreement.py runs/demo/results/trials.csv
"""

import sys
from pathlib import Path

import pandas as pd

from evaluator.statistics import agreement
from evaluator.statistics.intervals import wilson


def main(path: Path) -> None:
    """Print agreement trial by trial, and the rates of each group."""
    trials = pd.read_csv(path).dropna(subset=["recorded", "sim_planned"])
    agree = trials["recorded"] == trials["sim_planned"]
    interval = wilson(int(agree.sum()), len(agree))
    print(
        f"sim and outcome agree: {agree.sum()}/{len(agree)} = {agree.mean():.3f} "
        f"[{interval.low:.3f}, {interval.high:.3f}] ({interval.method})"
    )

    succeeded = trials[["recorded", "sim_planned"]] == "success"
    groups = [trials["task"], trials["condition"]]
    rates = succeeded.groupby(groups).mean()
    print(rates.to_string())
    recorded, sim = rates["recorded"].tolist(), rates["sim_planned"].tolist()
    print(f"bias (sim - recorded): {100 * agreement.bias(recorded=recorded, sim=sim):+.1f} pp")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
