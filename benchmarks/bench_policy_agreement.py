"""Ten policies in the stand-in cell and in its twin: does the twin order them as the cell does?

Written down before the first result, with seeds that no development used:

- Policies: ``judged_policies:looks_0`` to ``looks_9``, alike but for the size of their error, so
  that at least four should lie within 15 points of the best; that they do is a target, too.
- Tasks: ``judged_policies.TASKS``. Starts: session seed 7000, from 0 on, the same for every policy;
  20 for each (``POLICY_STARTS``), and ten policies (``POLICY_COUNT``: so many, evenly chosen).
- A trial in the cell: driven over zenoh at 10 Hz until the task's predicates hold, 30 s, or a
  limit; the operator's label counts. A rollout: from the same start as the twin localised it. A
  policy's error is drawn anew in each.
- Excluded: trials and rollouts that say nothing of a policy (its runner or its server failed, the
  start could not be localised); how many is printed. Nothing is tried again.
- r over groups (policy x task) with the interval over others like these, MMRV, and regret of the
  twin's first with the interval to the best: as ``robot-gst evaluate`` has them.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from judged_policies import ERRORS_MM, TASKS
from measure import ROOT, Target, report_targets

SEED, FULL_STARTS = 7000, 20
STARTS = int(os.environ.get("POLICY_STARTS", FULL_STARTS))
COUNT = int(os.environ.get("POLICY_COUNT", len(ERRORS_MM)))
CHOSEN_TASKS = tuple(os.environ.get("POLICY_TASKS", " ".join(TASKS)).split())
if STARTS != FULL_STARTS or len(ERRORS_MM) != COUNT or CHOSEN_TASKS != TASKS:
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
NEAR = 0.15


def chosen() -> list[int]:
    """Numbers of the policies."""
    return [int(number) for number in np.linspace(0, len(ERRORS_MM) - 1, COUNT).round()]


def run_study(run: Path) -> dict[str, Any]:
    """Trials, rollouts and the evaluation, by the commands that a user types."""
    names = [f"looks_{number}=judged_policies:looks_{number}" for number in chosen()]
    words = [sys.executable, str(ROOT / "robot_gst.py"), "trials", str(run.resolve())]
    words += ["--policies", *names, "--task", *CHOSEN_TASKS, "--seed", str(SEED)]
    subprocess.run([*words, "--trials", str(STARTS)], check=True, cwd=Path(__file__).parent)
    found: dict[str, Any] = json.loads((run / "results" / "results.json").read_text())
    return found


def main() -> None:
    """Run the study, or take up one that was interrupted (``POLICY_RUN``), and print it."""
    run = Path(os.environ.get("POLICY_RUN") or mkdtemp(prefix="policy_agreement_"))
    results = run_study(run)
    by_id = {item["id"]: item for item in results["measurements"]}
    rates = [by_id[name]["value"] for name in by_id if name.startswith("rate.recorded.")]
    best_of: dict[str, list[float]] = {}
    for name, item in by_id.items():
        if name.startswith("rate.recorded.") and item["value"] is not None:
            task = name.split(".")[2]
            best_of.setdefault(task, []).append(item["value"])
    near = min((sum(r >= max(row) - NEAR for r in row) for row in best_of.values()), default=0)
    r, mmrv, regret = (
        by_id.get(name, UNDEFINED)
        for name in ("agreement.pearson_r", "agreement.mmrv_recorded_gap", REGRET)
    )
    low = (r["interval"] or {}).get("low")
    high = (regret["interval"] or {}).get("high")
    excluded = [item["reason"] for item in results["exclusions"] if item["scope"] == "agreement"]
    rows = (
        ("r over groups", r["value"], 0.85, "", False),
        ("lower end of its interval", low, 0.6, "", False),
        ("MMRV", mmrv["value"], 0.05, "", True),
        ("upper end of the regret's interval", high, 10.0, "pp", True),
        ("policies within 15 points of the best", near, 4, "", False),
    )
    targets = [
        Target(what=what, measured=number(value), limit=limit, unit=unit, at_most=at_most)
        for what, value, limit, unit, at_most in rows
    ]
    note = f"{len(rates)} groups of {STARTS} trials ({len(ERRORS_MM) * len(TASKS)} of {FULL_STARTS}"
    note += f" asked for), regret {regret['value']}, {len(excluded)} trials left out; {run}"
    report_targets("bench_policy_agreement", targets, note=note, left_out=sorted(set(excluded)))


REGRET = "decision.regret_pp"
UNDEFINED: dict[str, Any] = {"value": None, "interval": None}


def number(value: float | None) -> float:
    """What was not defined misses every target."""
    return float("nan") if value is None else float(value)


if __name__ == "__main__":
    main()
