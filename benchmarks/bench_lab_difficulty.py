"""How hard the laboratory's tasks are for the scripted planner alone, on development seeds.

The cell's own physics carries out one plan per start, without cameras, zenoh and twin. Perception
is replaced by what localisation was measured to be off: 1.8 mm and 0.2 degrees in the median, and
what a laboratory is off as a whole, because its table is not level and its cameras are not as
published (seven development laboratories, the gate's own localisation). Heights are as it states
them: everything stands on the table z = 0. A control runs the same starts in a
laboratory that is as published: what fails only in the hidden one fails because of the world.

    python benchmarks/bench_lab_difficulty.py --labs 20 --starts 2

``--as-published steps`` runs the same starts with full edges: how much of the difficulty is theirs.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bridge.geometry import se3
from bridge.sources.standin.cell import CellConfig, StandinCell, TruthLog
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, draw_hidden, load_cell
from bridge.sources.standin.deviations import Deviations
from bridge.sources.standin.kinematics import UnreachablePoseError
from bridge.sources.standin.operator import execute_plan, label_trial
from bridge.sources.standin.planner import NO_ERROR, GraspError, plan_pick_and_place
from bridge.sources.standin.streams import Streams
from bridge.task.plan import Plan
from bridge.task.protocol import SEEDS_PER_SESSION
from bridge.task.task_file import Task, load_task
from evaluator.metrics.geometric_rule import judge_by_geometry

TASKS = (
    "push_cube_to_mark",
    "stack_two_cubes",
    "slippery_block_into_box",
    "heavy_block_into_box",
    "sloth_over_rim",
)
CELL = "lab"
MEDIAN_M, MEDIAN_RAD = 0.0018, np.deg2rad(0.2)
RAYLEIGH_MEDIAN, NORMAL_MEDIAN = 1.1774, 0.6745
"""Of a length with two normal parts, and of a normal value's size, in standard deviations."""
BIAS_M, BIAS_SPREAD_M = (0.0042, -0.0031), 0.0050
"""Of what localisation is off in a laboratory as a whole, x and y: mean and standard deviation.
Measured in seven: (9.1, 3.8), (3.1, -10.5), (4.1, -7.4), (10.0, -2.4), (-4.9, 1.2), (0.9, 0.0) and
(6.7, -6.1) mm, 8 mm long in the median."""
LOOK_STREAM = 909


class Nowhere:
    """A wire on which nothing arrives."""

    def publisher(self, topic: str, type_name: str, **_: Any) -> "Nowhere":
        """Return something to put into."""
        return self

    def put(self, data: bytes, *, source_ns: int) -> None:
        """Forget."""

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Nobody is asked."""
        raise NotImplementedError


def as_published(file: CellFile, task: Task) -> HiddenParameters:
    """A laboratory that is what it says: friction, weight and force as the twin takes them."""
    drawn = draw_hidden(file, file.development_seeds[0], task)
    return replace(
        drawn,
        finger_friction=0.80,
        object_friction=0.64,
        mass_scale=1.0,
        grip_N=task.grip_force_N or 20.0,
        stiffness_scale=1.0,
        joint_offset_rad=np.zeros_like(drawn.joint_offset_rad),
        deviations=None,
    )


SHIFT = "shift"
"""What localisation is off as a whole: no part of a laboratory, but of how it is seen."""


def partly_as_published(hidden: HiddenParameters, what: str) -> HiddenParameters:
    """The same laboratory but for one of its deviations; see ``PARTS``."""
    found = hidden.deviations
    if found is None or what not in PARTS:
        return hidden
    if what == "arm":
        hidden = replace(hidden, joint_offset_rad=np.zeros_like(hidden.joint_offset_rad))
    return replace(hidden, deviations=PARTS[what](found))


def _objects(found: Deviations, **fields: Any) -> Deviations:
    objects = {key: replace(item, **fields) for key, item in found.objects.items()}
    return replace(found, objects=objects)


def _straight_arm(found: Deviations) -> Deviations:
    still = (0.0,) * len(found.joint_zero_rad)
    links = dict.fromkeys(found.link_length_m, 0.0)
    return replace(found, link_length_m=links, joint_zero_rad=still, joint_backlash_rad=still)


PARTS: dict[str, Callable[[Deviations], Deviations]] = {
    "steps": lambda found: _objects(found, rebate_m=0.0),
    "centres": lambda found: _objects(found, centre_of_mass=(0.0, 0.0, 0.0)),
    "sizes": lambda found: _objects(found, size_scale=(1.0, 1.0, 1.0)),
    "table": lambda found: replace(found, table_height_m=0.0, table_tilt_rad=(0.0, 0.0)),
    "fingers": lambda found: replace(
        found, finger_shift_m=0.0, finger_thickness_m=0.0, finger_length_m=0.0
    ),
    "arm": _straight_arm,
}
"""What can be as published while all else stays hidden."""


def seen(
    task: Task, true: dict[str, np.ndarray], start_seed: int, lab: int | None
) -> dict[str, np.ndarray]:
    """True places seen a little wrong, upright on the published table; without a lab, no bias."""
    rng = np.random.default_rng([LOOK_STREAM, start_seed])
    bias_m = np.zeros(3)
    if lab is not None:
        whole = np.random.default_rng([LOOK_STREAM, 1, lab])
        bias_m[:2] = whole.normal(BIAS_M, BIAS_SPREAD_M)
    poses = {}
    for key, T in sorted(true.items()):
        yaw = np.arctan2(T[1, 0], T[0, 0]) + rng.normal(0.0, MEDIAN_RAD / NORMAL_MEDIAN)
        p = T[:3, 3] + bias_m + np.array([*rng.normal(0.0, MEDIAN_M / RAYLEIGH_MEDIAN, 2), 0.0])
        p[2] = task.objects[key].rest_height_m
        poses[key] = se3.transform_from(np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]), p)
    return poses


def trial(cell: StandinCell, start_seed: int, lab: int | None = None) -> dict[str, Any]:
    """One start, one plan: what became of it, and what geometry alone says of the plan."""
    task = cell.task
    cell.reset(task.draw_start(np.random.default_rng(start_seed)))
    cell.wait(0.4)
    perceived = seen(task, cell.world.Ts_base_object(), start_seed, lab)
    try:
        plan = planned(cell, perceived)
    except UnreachablePoseError as error:
        return {"start": start_seed, "result": "failure", "cause": "no plan", "detail": str(error)}
    cell.truth = TruthLog()
    execute_plan(cell, plan)
    outcome = label_trial(cell.world.task, cell.truth, executed=True)
    failed = [stage["id"] for stage in outcome.stages if stage["result"] != "success"]
    return {
        "start": start_seed,
        "result": outcome.result,
        "cause": "" if outcome.result == "success" else f"stage {failed[0] if failed else 'none'}",
        "detail": outcome.detail,
        "geometry": judge_by_geometry(plan, task, perceived).value,
    }


def planned(
    cell: StandinCell,
    perceived: dict[str, np.ndarray],
    errors: GraspError | Sequence[GraspError] = NO_ERROR,
) -> Plan:
    """The scripted plan; without errors of its own unless some are given."""
    return plan_pick_and_place(
        cell.task,
        perceived,
        errors,
        kinematics=cell.kinematics,
        joints_start_rad=cell.home_rad,
        max_joint_speed_rad_s=cell.file.max_joint_speed_rad_s,
        plan_id="plan",
        condition="without_replanning",
        start_id="start",
    )


def laboratory(file: CellFile, task: Task, hidden: HiddenParameters, seed: int) -> StandinCell:
    """The cell without cameras."""
    return StandinCell(
        file,
        task,
        hidden,
        Streams(Nowhere(), CELL),
        config=CellConfig(rate_hz=0.0),
        seed=seed,
        start_ns=0,
    )


def measured(
    name: str, *, labs: int, starts: int, controls: int, first: int, known: str = ""
) -> dict[str, Any]:
    """All trials of one task, and the control."""
    file, task = load_cell(CELL), load_task(name)
    low, high = file.development_seeds
    rows, began_s = [], time.process_time()
    for seed in range(low + first, low + first + labs):
        if seed > high:
            message = f"seed {seed} is no development seed"
            raise ValueError(message)
        hidden = partly_as_published(draw_hidden(file, seed, task), known)
        cell = laboratory(file, task, hidden, seed)
        shifted = None if known == SHIFT else seed
        for index in range(starts):
            rows.append({"lab": seed, **trial(cell, seed * SEEDS_PER_SESSION + index, shifted)})
    plain = laboratory(file, task, as_published(file, task), low)
    control = [trial(plain, (low + first + k) * SEEDS_PER_SESSION) for k in range(controls)]
    return {
        "task": name,
        "n": len(rows),
        "k": sum(row["result"] == "success" for row in rows),
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
    parser.add_argument("--controls", type=int, default=6)
    parser.add_argument("--first", type=int, default=0, help="development seed to begin with")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--details", action="store_true")
    parser.add_argument("--as-published", choices=[*PARTS, SHIFT], default="")
    asked = parser.parse_args()
    found = []
    for name in asked.tasks:
        row = measured(
            name,
            labs=asked.labs,
            starts=asked.starts,
            controls=asked.controls,
            first=asked.first,
            known=asked.as_published,
        )
        found.append(row)
        print(
            f"{name}: {row['k']} of {row['n']} succeed, {row['causes']}; geometry right "
            f"{row['geometry_right']}; as published {row['control_k']} of {row['control_n']} "
            f"{row['control_details']}; {row['cpu_s']} s CPU",
            flush=True,
        )
        if asked.details:
            for trial_row in row["trials"]:
                print(f"  {trial_row['lab']} {trial_row['result']}: {trial_row['detail']}")
    if asked.out:
        asked.out.write_text(json.dumps({"cell": CELL, "tasks": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
