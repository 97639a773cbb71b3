"""Paths of the planner, against OMPL's RRT-Connect and TOPP-RA in the same run.

Forty pairs of postures among a box, a post and a wall, and where the arm is in its own way; none
can be joined straight. OMPL (its Python package) asks the project's exact clearance at every
0.05 rad of an edge. Both find, then shorten. TOPP-RA gets the very curve that is timed here, and
the cubic spline through the knots.

CPU time of this process, one thread. References: pip install ompl toppra (or their folder on
PYTHONPATH); what is not there is left out.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets

sys.path.insert(0, str(ROOT / "tests" / "twin" / "plan" / "path"))

from path_scene import EPS_M, WIDTH_M, Pairs, pairs_of_test

from twin.plan.path.planner import Mover, PathConfig, limits_of, timed_path
from twin.replay.clearance.bodies import own_links_touch
from twin.replay.clearance.surroundings import Surroundings
from twin.robot.collision import hulls_of

NOTE = "UR5 and parallel gripper, 40 pairs that need a detour; CPU time, one thread"
EDGE_RAD = 0.05
SEED = 22


def cpu_ms(work: Callable[[], Any], *, repeats: int = 5) -> float:
    """Median CPU time of a call [ms]."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append((time.process_time() - start) * 1e3)
    return statistics.median(times)


def native(pairs: Pairs, index: int, seed: int = SEED, shortcuts: int = 60) -> Any:
    """One search with its shortcuts."""
    start, goals = pairs.starts[index], pairs.goals[index][None]
    return pairs.world.motion.find(start, goals, seed, 1.0, 5000, 150_000, shortcuts)


def exact_check(pairs: Pairs) -> Callable[[np.ndarray], bool]:
    """The project's exact clearance of one posture: links, what stands, objects."""
    hulls, scene = hulls_of(pairs.problem.robot), pairs.problem.scene
    surroundings, links_touch = Surroundings(scene, hulls, EPS_M), own_links_touch(hulls)

    def free(joints: np.ndarray) -> bool:
        hulls.place(joints, WIDTH_M)
        if links_touch():
            return False
        distances, _ = surroundings.measure(
            scene.movable(), [], near_m=EPS_M, counts=lambda body, other: True
        )
        return min(distances.values()) >= EPS_M

    return free


def ompl_ms(pairs: Pairs, free: Callable[[np.ndarray], bool]) -> tuple[list[float], list[float]]:
    """What OMPL's RRT-Connect needs for each pair, and with its own simplification [ms]."""
    from ompl import base as ob
    from ompl import geometric as og
    from ompl import util as ou

    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    ou.RNG.setSeed(SEED)
    robot = pairs.problem.robot
    dof = len(robot.joints)
    space = ob.RealVectorStateSpace(dof)
    bounds = ob.RealVectorBounds(dof)
    for joint in range(dof):
        bounds.setLow(joint, float(robot.lower_rad[joint]))
        bounds.setHigh(joint, float(robot.upper_rad[joint]))
    space.setBounds(bounds)
    solved, simplified = [], []
    for start, goal in zip(pairs.starts, pairs.goals, strict=True):
        setup = og.SimpleSetup(space)
        setup.setStateValidityChecker(lambda s: free(np.array([s[j] for j in range(dof)])))
        info = setup.getSpaceInformation()
        info.setStateValidityCheckingResolution(EDGE_RAD / space.getMaximumExtent())
        setup.setPlanner(og.RRTConnect(info))
        ends = []
        for posture in (start, goal):
            state = space.allocState()
            for j in range(dof):
                state[j] = float(posture[j])
            ends.append(state)
        setup.setStartAndGoalStates(*ends)
        begun = time.process_time()
        answer = setup.solve(30.0)
        found = time.process_time() - begun
        if answer and setup.haveExactSolutionPath():
            setup.simplifySolution()
            solved.append(found * 1e3)
            simplified.append((time.process_time() - begun) * 1e3)
    return solved, simplified


def search_rows(pairs: Pairs) -> list[Target]:
    """Time of the search, and whether the exact checks agree with what it found."""
    times = [cpu_ms(lambda i=i: native(pairs, i)) for i in range(len(pairs.kinds))]
    first = [cpu_ms(lambda i=i: native(pairs, i, shortcuts=0)) for i in range(len(pairs.kinds))]
    config = PathConfig()
    accepted, knots = 0, 0
    mover = Mover(problem=pairs.problem, config=config, width_m=WIDTH_M)
    decisions = []
    for index in range(len(pairs.kinds)):
        outcome, _, found, _ = native(pairs, index)
        if outcome:
            continue
        path = timed_path(pairs.world, found, config)
        begun = time.process_time()
        refused = mover.refused(path)
        decisions.append((time.process_time() - begun) * 1e3)
        accepted += int(not refused)
        knots += len(path.times_s)
    median, p95 = float(np.median(times)), float(np.percentile(times, 95))
    by_kind = ", ".join(
        f"{kind} {np.median([t for t, k in zip(times, pairs.kinds, strict=True) if k == kind]):.1f}"
        for kind in dict.fromkeys(pairs.kinds)
    )
    rows = [
        Target(what="paths valid by the swept clearance", measured=float(accepted),
               limit=float(len(pairs.kinds)), at_most=False,
               reference=f"{knots} knots, {np.median(decisions):.0f} ms to decide"),
        Target(what="search and shortcuts, median", measured=median, limit=3.0, unit="ms",
               reference=f"without shortcuts {np.median(first):.2f} ms; {by_kind} ms"),
        Target(what="search and shortcuts, 95 %", measured=p95, limit=10.0, unit="ms"),
    ]  # fmt: skip
    if importlib.util.find_spec("ompl") is None:
        print("ompl is not installed: no ratio")
        return rows
    free = exact_check(pairs)
    solved, simplified = ompl_ms(pairs, free)
    ratio = float(np.median(simplified)) / median
    return [
        *rows,
        Target(what="OMPL RRT-Connect and simplification over ours", measured=ratio, limit=30.0,
               unit="x", at_most=False,
               reference=f"OMPL {len(solved)} of {len(times)}: {np.median(solved):.0f} ms, "
               f"simplified {np.median(simplified):.0f} ms; found alone "
               f"{np.median(solved) / np.median(first):.0f} x"),
    ]  # fmt: skip


def sweep_rows(pairs: Pairs, count: int) -> list[Target]:
    """Ways that are called free, looked at by coal in forty places each."""
    free, rng = exact_check(pairs), np.random.default_rng(SEED)
    home = pairs.problem.robot.home_rad
    found = wrong = 0
    while found < count:
        start = home + rng.uniform(-1.3, 1.3, 6)
        way = np.stack([start, start + rng.uniform(-0.9, 0.9, 6)])
        if pairs.world.motion.blocked(way) >= 0:
            continue
        found += 1
        shares = np.sort(rng.uniform(0, 1, 40))[:, None]
        wrong += 1 - all(free(row) for row in way[0] + shares * (way[1] - way[0]))
    return [
        Target(
            what=f"of {count} free ways, those with a violation", measured=float(wrong), limit=0.0
        )
    ]


def toppra_s(
    points: np.ndarray, at: np.ndarray, speed: np.ndarray, acceleration: np.ndarray
) -> tuple[float, float]:
    """Duration by TOPP-RA through points [s], and its CPU time [ms]."""
    import toppra
    from toppra import algorithm, constraint

    toppra.setup_logging("ERROR")
    begun = time.process_time()
    path = toppra.SplineInterpolator(at, points)
    limits = [
        constraint.JointVelocityConstraint(np.stack([-speed, speed], axis=1)),
        constraint.JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
    ]
    grid = np.linspace(0, path.path_interval[1], 200)
    answer = algorithm.TOPPRA(limits, path, gridpoints=grid).compute_trajectory()
    spent = (time.process_time() - begun) * 1e3
    return (float("nan") if answer is None else float(answer.duration)), spent


def timing_rows(pairs: Pairs) -> list[Target]:
    """Time laws of the same paths."""
    config = PathConfig()
    speed, acceleration, _ = limits_of(pairs.problem.robot, config)
    ours, stops, curve, spline, cost, theirs, over = [], [], [], [], [], [], []
    has_toppra = importlib.util.find_spec("toppra") is not None
    for index in range(len(pairs.kinds)):
        knots = native(pairs, index)[2]

        def law(rounding: bool = True, knots: np.ndarray = knots) -> Any:
            return pairs.world.motion.time(knots, speed, acceleration, 0.0, 0.02, rounding)

        times, rows, at, points = law()
        cost.append(cpu_ms(law))
        ours.append(times[-1])
        stops.append(law(rounding=False)[0][-1])
        step = np.diff(times)
        rates = np.diff(rows, axis=0) / step[:, None]
        change = np.abs(np.diff(rates, axis=0)) / ((step[1:] + step[:-1]) / 2)[:, None]
        over.append(max((np.abs(rates) / speed).max(), (change / acceleration).max()))
        if has_toppra:
            same, spent = toppra_s(points, at, speed, acceleration)
            along = np.linalg.norm(np.diff(knots, axis=0), axis=1)
            places = np.concatenate([[0], np.cumsum(along)])
            curve.append(times[-1] / same)
            spline.append(times[-1] / toppra_s(knots, places, speed, acceleration)[0])
            theirs.append(spent)
    about = f"median duration {np.median(ours):.2f} s, stopping at corners {np.median(stops):.2f} s"
    rows_out = [
        Target(what="time law: most of a limit", measured=100 * float(max(over)), limit=101.0,
               unit="%"),
        Target(what="time law: rounding and times", measured=float(np.median(cost)), limit=15.0,
               unit="ms", reference=about),
    ]  # fmt: skip
    if not has_toppra:
        print("toppra is not installed: no comparison of durations")
        return rows_out
    return [
        *rows_out,
        Target(what="time law: duration over TOPP-RA's, the same curve",
               measured=float(np.nanmedian(curve)), limit=1.1, unit="x",
               reference=f"worst {np.nanmax(curve):.2f}; over TOPP-RA's of the cubic spline "
               f"{np.nanmedian(spline):.2f}, worst {np.nanmax(spline):.2f}; TOPP-RA "
               f"{np.median(theirs):.1f} ms"),
    ]  # fmt: skip


def main() -> None:
    """Measure everything once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ways", type=int, default=1000)
    sizes = parser.parse_args()
    pairs = pairs_of_test(each=10)
    rows = [
        *search_rows(pairs),
        *timing_rows(pairs),
        *sweep_rows(pairs, sizes.ways),
    ]
    report_targets("plan_path", rows, note=NOTE)


if __name__ == "__main__":
    main()
