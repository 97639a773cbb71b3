"""Final states: candidate poses of 200 points against two grids, and whole searches.

The reference is the same distances in NumPy, all points of a batch at once, as they were before
the loop was native. Numbers must agree. Then the cube is put into the box of the planner's
benchmarks with everything on: stage problems, perturbations, ranking.

Arguments: number of candidates (8000).
"""

import statistics
import sys

import numpy as np
from measure import Target, cpu_seconds, report_targets
from plan_cell import box_with_wall

from bridge.geometry import se3
from twin.plan.release.distances import candidate_clearance
from twin.plan.release.final_states import ReleaseConfig, final_states
from twin.replay.clearance.distance_grid import GridLookup
from twin.scene.shape.sdf import SdfGrid, distances_of_solid

CANDIDATES, POINTS, BATCH, SEED = 8000, 200, 60, 5
NOTE = "CPU time of one thread; machine shared"


def static_grid() -> GridLookup:
    """A table with a wall, 10.7 mm voxels, in the base frame."""
    solid = np.zeros((110, 130, 70), dtype=np.bool_)
    solid[:, :, :4] = True
    solid[40:60, 75:77, 4:30] = True
    values = distances_of_solid(solid, 0.0107)
    return GridLookup(SdfGrid(values_m=values, origin_m=np.array([0, -0.7, -0.04]), voxel_m=0.0107))


def object_grid() -> GridLookup:
    """An open box of 1.6 mm voxels, in the base frame."""
    solid = np.zeros((110, 110, 45), dtype=np.bool_)
    solid[5:105, 5:105, 5:40] = True
    solid[9:101, 9:101, 9:] = False
    values = distances_of_solid(solid, 0.0016)
    origin = np.array([0.41, 0.1, -0.01])
    return GridLookup(SdfGrid(values_m=values, origin_m=origin, voxel_m=0.0016))


def candidates(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a ball and poses around the inside of the box."""
    rng = np.random.default_rng(SEED)
    points = rng.normal(size=(POINTS, 3))
    points *= 0.025 / np.linalg.norm(points, axis=1, keepdims=True)
    Ts = np.repeat(np.eye(4)[None], count, axis=0)
    Ts[:, :3, :3] = se3.rotation_from_vector(rng.uniform(-0.2, 0.2, (count, 3)))
    Ts[:, :3, 3] = np.array([0.5, 0.19, 0.06]) + rng.uniform(-0.08, 0.08, (count, 3))
    return points, Ts


def in_numpy(lookup: GridLookup, points: np.ndarray, Ts: np.ndarray) -> np.ndarray:
    found = []
    for start in range(0, len(Ts), BATCH):
        some = Ts[start : start + BATCH]
        placed = points @ np.swapaxes(some[:, :3, :3], 1, 2) + some[:, None, :3, 3]
        found.append(lookup.distance(placed.reshape(-1, 3)).reshape(len(some), -1).min(axis=1))
    return np.concatenate(found)


def main() -> None:
    """Speed and agreement, then whole searches."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else CANDIDATES
    grids = static_grid(), object_grid()
    points, Ts = candidates(count)
    ours = statistics.median(
        cpu_seconds(lambda: [candidate_clearance(g, points, Ts) for g in grids], repeats=5)
    )
    reference = statistics.median(
        cpu_seconds(lambda: [in_numpy(g, points, Ts) for g in grids], repeats=3)
    )
    off = max(
        float(np.abs(candidate_clearance(g, points, Ts) - in_numpy(g, points, Ts)).max())
        for g in grids
    )
    problem, grasp = box_with_wall()
    seconds = cpu_seconds(lambda: final_states(problem, grasp), repeats=5)
    found = final_states(problem, grasp)
    rows = [
        Target(what="release candidates, 200 points, two grids", measured=count / ours,
               limit=40_000.0, unit="1/s", at_most=False,
               reference=f"NumPy {count / reference:.0f} 1/s"),
        Target(what="release: largest difference to NumPy", measured=off * 1e6, limit=10.0,
               unit="um"),
        Target(what="final states of a cube, distinct", measured=len(found), limit=5,
               at_most=False, reference=f"{ReleaseConfig().num_samples} perturbed poses"),
        Target(what="final states of a cube, CPU", measured=statistics.median(seconds), limit=1.0,
               unit="s"),
    ]  # fmt: skip
    report_targets("plan_release", rows, note=NOTE)


if __name__ == "__main__":
    main()
