"""Soft bodies in the twin: speed per core, quality of pick-and-place, disagreement with MuJoCo.

One fixed setting for everything: ``PhysicsConfig()`` as it is. Quality draws Young's modulus of
1e4-1e5 Pa, 20-100 g, friction 0.3-1.0, grasps that miss by up to 4 mm and 4.6 degrees. First
argument: trials per toy; second: first seed.
"""

import statistics
import sys

import numpy as np
from measure import Target, report_targets

TRIALS, FIRST_SEED = 24, 0
NOTE = "UR5 + gripper in PyBullet, scripted plan, CPU time of one core, physics only"
SPEED = {"duck": 15.0, "sloth": 10.0, "five ducks": 4.0}
NEEDED = 22 / 24


def main() -> None:
    """Speed, then quality, then MuJoCo."""
    from soft_cell import draw_trial, in_mujoco, one_duck, replayed

    from bridge.task.task_file import load_task

    trials = int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS
    first = int(sys.argv[2]) if len(sys.argv) > 2 else FIRST_SEED
    tasks = {
        "duck": one_duck(),
        "sloth": load_task("sloth_into_basket"),
        "five ducks": load_task("five_ducks_into_basket"),
    }
    targets, apart = [], []
    for name, task in tasks.items():
        trial = draw_trial(task, first, varied=False)
        rates = []
        for _ in range(3 if name != "five ducks" else 2):
            toys, simulated_s, cpu_s = replayed(trial)
            rates.append(simulated_s / cpu_s)
        there = in_mujoco(trial)
        for key, toy in toys.items():
            apart.append(1e3 * distance_m(toy.T_base_object, there[key]))
        placed = sum(toy.held and toy.placed for toy in toys.values())
        targets.append(
            Target(what=f"{name}: times real time", measured=statistics.median(rates),
                   limit=SPEED[name], unit="x", at_most=False,
                   reference=f"{placed} of {len(toys)} held and placed, {simulated_s:.0f} s")
        )  # fmt: skip
    print(f"  final places against MuJoCo flex: {summary(apart)}")
    for name in ("duck", "sloth"):
        targets += quality(name, [
            next(iter(replayed(draw_trial(tasks[name], seed, varied=True))[0].items()))[1]
            for seed in range(first, first + trials)
        ])  # fmt: skip
    report_targets("replay_soft", targets, note=NOTE, apart_from_mujoco_flex_mm=apart)


def distance_m(T: np.ndarray, T_other: np.ndarray) -> float:
    """Between two origins."""
    return float(np.linalg.norm(T[:3, 3] - T_other[:3, 3]))


def summary(apart_mm: list[float]) -> str:
    """Median and largest."""
    return (
        f"median {statistics.median(apart_mm):.0f} mm, largest {max(apart_mm):.0f} mm "
        f"of {len(apart_mm)} toys"
    )


def quality(name: str, toys: list) -> list[Target]:
    """The lines for one toy."""
    done = [toy for toy in toys if toy.held and toy.placed]
    return [
        Target(what=f"{name}: held and placed", measured=len(done) / len(toys), limit=NEEDED,
               at_most=False, reference=f"{len(done)} of {len(toys)}"),
        Target(what=f"{name}: inverted elements", limit=0,
               measured=float(sum(toy.num_inverted for toy in toys))),
        Target(what=f"{name}: extents off, largest", limit=0.10,
               measured=max(toy.extents_off for toy in toys)),
        Target(what=f"{name}: shape error, largest", limit=5.0, unit="mm",
               measured=max(toy.shape_error_m for toy in toys) * 1e3),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
