"""Stage optimisation against what ReKep does: dual annealing with SLSQP, same objective, same run.

A cube is put into a box that another cube lies in and a wall stands beside; nothing may touch
anything (eps 2 mm): panels, wall, the open hand. Seven variables: position, rotation, width. The
reference is SciPy's dual annealing with 5,000 evaluations and SLSQP as its local search, and SLSQP
once more from what it finds; it gets one state at a time, as such a solver asks.

Arguments: number of seeds (5).
"""

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from measure import Target, report_targets
from plan_cell import box_with_wall
from scipy.optimize import dual_annealing, minimize

from twin.plan.release.final_states import (
    DROP_M,
    MOST_TOOL_TILT_RAD,
    ReleaseConfig,
    ReleaseSearch,
)
from twin.plan.release.resting import resting_poses, target_of
from twin.plan.stage.objective import StageProblem, Zeta, moved
from twin.plan.stage.solver import SPREAD_M, solve

SEEDS, MAX_EVALUATIONS, SLSQP_STEPS = 5, 5000, 200
SETTINGS = replace(ReleaseConfig().solver(), num_starts=32, iterations=30, redraws=2)
NOTE = "a cube into an occupied box beside a wall; CPU time of one thread; machine shared"


Result = TypeVar("Result")


def release_stage() -> StageProblem:
    problem, grasp = box_with_wall()
    task = problem.scene.task
    stages = [{**dict(stage), "allowed_contacts": ()} for stage in task.stages]
    scene = replace(problem.scene, task=replace(task, stages=tuple(stages)))
    problem = replace(problem, scene=scene)
    search = ReleaseSearch(problem, grasp, (), ReleaseConfig())
    target = target_of(problem, grasp.object_id)
    ways = resting_poses(problem, grasp, target, drop_m=DROP_M, most_tilted_rad=MOST_TOOL_TILT_RAD)
    return search.stage(ways[0], target)


def annealed(stage: StageProblem, seed: int) -> tuple[float, int]:
    """J of the best state that dual annealing and SLSQP find, and evaluations."""
    settings = SETTINGS
    spread = [SPREAD_M] * 3 + [settings.spread_rad] * 2 + [np.pi]
    bounds = [(-s, s) for s in spread] + [(0.0, stage.max_width_m)]
    count = 0

    def cost(x: np.ndarray) -> float:
        nonlocal count
        count += 1
        T = moved(stage.nominal_T_base_tcp[None], x[None, :6])
        return float(stage.cost(Zeta(T_base_tcp=T, width_m=x[6:7]))[0])

    start = np.array([0.0] * 6 + [stage.nominal_width_m])
    local = {"method": "SLSQP", "options": {"maxiter": SLSQP_STEPS}}
    found = dual_annealing(
        cost, bounds, x0=start, maxfun=MAX_EVALUATIONS, rng=seed, minimizer_kwargs=local
    )
    last = minimize(cost, found.x, bounds=bounds, **local)
    return min(float(found.fun), float(last.fun)), count


def timed(work: Callable[[], Result]) -> tuple[float, Result]:
    """CPU time and what came out."""
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def main() -> None:
    """Both solvers, seed by seed, one after the other."""
    seeds = range(int(sys.argv[1]) if len(sys.argv) > 1 else SEEDS)
    stage = release_stage()
    solve(stage, SETTINGS, seed=99)
    ours_s, reference_s, costs, reference_costs, feasible, num = [], [], [], [], [], []
    for seed in seeds:
        seconds, solution = timed(lambda seed=seed: solve(stage, SETTINGS, seed=seed))
        ours_s.append(seconds)
        feasible.append(int(solution.feasible.sum()))
        num.append(len(solution.candidates))
        costs.append(solution.candidates[0].cost if solution.candidates else np.inf)
        seconds, (cost, evaluations) = timed(lambda seed=seed: annealed(stage, seed))
        reference_s.append(seconds)
        reference_costs.append(cost)
        print(f"seed {seed}: J {costs[-1]:.6f} in {ours_s[-1]:.3f} s")
        print(f"    {feasible[-1]} feasible, {num[-1]} distinct")
        print(f"    annealing: J {cost:.6f} in {seconds:.3f} s, {evaluations} evaluations")
    ours, theirs = statistics.median(ours_s), statistics.median(reference_s)
    worst = max(a / b for a, b in zip(costs, reference_costs, strict=True))
    rows = [
        Target(what="stage: feasible of 32 starts", measured=min(feasible), limit=24,
               at_most=False),
        Target(what="stage: distinct feasible answers", measured=min(num), limit=5,
               at_most=False),
        Target(what="stage: best J over that of annealing, worst seed", measured=worst, limit=1.0,
               reference=f"J {statistics.median(costs):.5f} against "
               f"{statistics.median(reference_costs):.5f}"),
        Target(what="stage: CPU over that of annealing", measured=ours / theirs, limit=0.35,
               reference=f"{ours:.3f} s against {theirs:.3f} s"),
    ]  # fmt: skip
    report_targets("plan_stage", rows, note=NOTE)


if __name__ == "__main__":
    main()
