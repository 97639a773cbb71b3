"""One pick and place, planned and verified once: CPU time of this process, one thread.

The start is drawn from the task's own distribution; the twin judges as a gate does, its audit
included. What Python imports is loaded before.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from measure import Target, report_targets

from bridge.robots.default import ROBOT
from bridge.task.task_file import load_task
from twin.gate.twin_process import judge_of
from twin.plan.loop.nominal import PlanProposer
from twin.plan.loop.propose import choose
from twin.plan.problem import Problem
from twin.plan.shapes import shapes_of
from twin.replay.scene import ReplayScene
from twin.robot.model import load_robot

NOTE = "cube into box, planner nominal, no rebuilt scene; CPU time, one thread"
HOME_RAD = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])


def problem_of_start(task_name: str, seed: int) -> Problem:
    """A start of a task as drawn, every object known to a millimetre."""
    task = load_task(task_name)
    Ts = task.draw_start(np.random.default_rng(seed))
    sure = np.diag([1e-6] * 3 + [1e-4] * 3)
    urdf = ROBOT.urdf_text()
    scene = ReplayScene(
        task=task,
        Ts_base_object=Ts,
        urdf=urdf,
        covariances=dict.fromkeys(Ts, sure),
        start_rad=HOME_RAD,
    )
    return Problem(scene=scene, robot=load_robot(urdf), shapes=shapes_of(None, task))


def planned_and_verified(seed: int, run: Path) -> tuple[float, float, bool]:
    """CPU seconds to plan and to verify, and whether the twin accepted."""
    problem = problem_of_start("cube_into_box", seed)
    begun = time.process_time()
    candidate = choose(
        PlanProposer(), problem, plan_id="p", seed=seed, round_=0, refused=(), most=5
    )
    planned = time.process_time()
    verdict = judge_of(run, problem.scene)(candidate.plan)
    return planned - begun, time.process_time() - planned, verdict.accepted is True


def main() -> None:
    """Measure a few starts, the first of which only loads what is needed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=10)
    count = parser.parse_args().starts
    with tempfile.TemporaryDirectory() as folder:
        found = [planned_and_verified(seed, Path(folder)) for seed in range(count + 1)][1:]
    plan_s = statistics.median(plan for plan, _, _ in found)
    verify_s = statistics.median(verify for _, verify, _ in found)
    both_s = statistics.median(plan + verify for plan, verify, _ in found)
    rows = [
        Target(what="one pick and place, planned and verified once", measured=both_s, limit=2.0,
               unit="s", reference=f"planned {plan_s:.2f} s, verified {verify_s:.2f} s"),
        Target(what="first candidates that the twin accepts",
               measured=float(sum(accepted for *_, accepted in found)), limit=0.9 * count,
               at_most=False, reference=f"of {count} starts"),
    ]  # fmt: skip
    report_targets("plan_once", rows, note=NOTE)


if __name__ == "__main__":
    main()
