"""How hard the tasks with several cubes are for the scripted planner, on development seeds.

The cell's own physics carries out one plan per start as the cell draws it, errors and all, without
cameras, zenoh and twin. A control runs the same starts in a laboratory that is as published, with a
planner that makes no error: what fails there is the plan's own fault.

    python benchmarks/bench_cubes_difficulty.py --labs 20 --starts 2 --out FILE
"""

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from bench_lab_difficulty import as_published, laboratory, planned

from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.cell_file import draw_hidden, load_cell
from bridge.sources.standin.kinematics import UnreachablePoseError
from bridge.sources.standin.operator import execute_plan, label_trial
from bridge.sources.standin.planner import NO_ERROR, draw_errors, perceive
from bridge.task.protocol import SEEDS_PER_SESSION
from bridge.task.task_file import load_task
from evaluator.metrics.geometric_rule import judge_by_geometry

TASKS = (
    "sort_by_colour",
    "cube_beside_cube",
    "clear_then_place",
    "cube_on_block",
    "stack_and_pack",
)


def trial(cell: StandinCell, start_seed: int, *, errs: bool) -> dict[str, Any]:
    """One start, one plan: what became of it, and what geometry alone says of the plan."""
    task, noise = cell.task, cell.file.noise_for(cell.task.name)
    cell.reset(task.draw_start(np.random.default_rng(start_seed)))
    cell.wait(0.4)
    true = cell.world.Ts_base_object()
    seen = perceive(true, noise, start_seed=start_seed) if errs else true
    count = len(task.manipulated)
    drawn = draw_errors(noise, count, start_seed=start_seed, round_=0)
    row: dict[str, Any] = {"start": start_seed}
    try:
        plan = planned(cell, seen, drawn if errs else NO_ERROR)
    except UnreachablePoseError as error:
        return row | {"result": "failure", "k": 0, "cause": "no plan", "detail": str(error)}
    cell.truth.clear()
    execute_plan(cell, plan)
    outcome = label_trial(cell.world.task, cell.truth, executed=True)
    failed = [stage["id"] for stage in outcome.stages if stage["result"] != "success"]
    return row | {
        "result": outcome.result,
        "k": outcome.k,
        "cause": "" if outcome.result == "success" else f"stage {failed[0] if failed else 'none'}",
        "detail": outcome.detail,
        "geometry": judge_by_geometry(plan, task, true).value,
    }


def measured(name: str, *, labs: int, starts: int, controls: int, first: int) -> dict[str, Any]:
    """All trials of one task, and the control."""
    task = load_task(name)
    file = load_cell(task.cell)
    low, high = file.development_seeds
    rows, began_s = [], time.process_time()
    for seed in range(low + first, low + first + labs):
        if seed > high:
            message = f"seed {seed} is no development seed"
            raise ValueError(message)
        cell = laboratory(file, task, draw_hidden(file, seed, task), seed)
        for index in range(starts):
            found = trial(cell, seed * SEEDS_PER_SESSION + index, errs=True)
            rows.append({"lab": seed, **found})
    plain = laboratory(file, task, as_published(file, task), low)
    seeds = [(low + first + k) * SEEDS_PER_SESSION for k in range(controls)]
    control = [trial(plain, seed, errs=False) for seed in seeds]
    return {
        "task": name,
        "cell": task.cell,
        "n": len(rows),
        "k": sum(row["result"] == "success" for row in rows),
        "objects_n": len(rows) * len(task.manipulated),
        "objects_k": sum(row["k"] for row in rows),
        "causes": dict(Counter(row["cause"] for row in rows if row["cause"])),
        "geometry_right": sum(row.get("geometry") == (row["result"] == "success") for row in rows),
        "control_n": len(control),
        "control_k": sum(row["result"] == "success" for row in control),
        "control_details": [row["detail"] for row in control if row["result"] != "success"],
        "cpu_s": round(time.process_time() - began_s, 1),
        "trials": rows,
    }


def main() -> None:
    """Print the table, and write it where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", default=TASKS)
    parser.add_argument("--labs", type=int, default=20)
    parser.add_argument("--starts", type=int, default=2)
    parser.add_argument("--controls", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="development seed to begin with")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--details", action="store_true")
    asked = parser.parse_args()
    found = []
    for name in asked.tasks:
        row = measured(
            name, labs=asked.labs, starts=asked.starts, controls=asked.controls, first=asked.first
        )
        found.append(row)
        print(
            f"{name}: {row['k']} of {row['n']} succeed, {row['objects_k']} of {row['objects_n']} "
            f"objects, {row['causes']}; geometry right {row['geometry_right']}; as published "
            f"{row['control_k']} of {row['control_n']} {row['control_details']}; {row['cpu_s']} s "
            "CPU",
            flush=True,
        )
        if asked.details:
            for trial_row in row["trials"]:
                print(f"  {trial_row['lab']} {trial_row['result']}: {trial_row['detail']}")
    if asked.out:
        asked.out.write_text(json.dumps({"tasks": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
