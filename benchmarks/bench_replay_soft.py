"""Soft bodies in the twin: speed per core, quality of pick-and-place, disagreement with MuJoCo.

One fixed setting for everything: ``PhysicsConfig()`` as it is. Quality draws Young's modulus of
1e4-1e5 Pa, 20-100 g, friction 0.3-1.0, grasps that miss by up to 4 mm and 4.6 degrees. The sloth
also as a rebuilt scene has it: a lattice of 9 mm, which physics takes at the task's spacing. First
argument: trials per toy; second: first seed.
"""

import hashlib
import os
import statistics
import subprocess
import sys

import numpy as np
from measure import Target, report_targets

TRIALS, FIRST_SEED = 24, 0
REPEATS = int(os.environ.get("GST_BENCH_REPEATS", "20"))
NOTE = "UR5 + gripper in PyBullet, scripted plan, CPU time of one core, physics only"
AS_SCENE = "sloth of a scene"
SPEED = {"duck": 15.0, "sloth": 10.0, AS_SCENE: 10.0, "five ducks": 4.0}
DIGEST_STEPS = 1200
"""Of 240 a second: down, closed, and lifted."""
NEEDED = 22 / 24


def main() -> None:
    """Speed, then quality, then MuJoCo, then the bytes."""
    from soft_cell import draw_trial, in_mujoco, one_duck, replayed

    from bridge.task.task_file import load_task

    trials = int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS
    first = int(sys.argv[2]) if len(sys.argv) > 2 else FIRST_SEED
    sloth = load_task("sloth_into_basket")
    tasks = {
        "duck": one_duck(),
        "sloth": sloth,
        AS_SCENE: sloth,
        "five ducks": load_task("five_ducks_into_basket"),
    }
    targets, apart = [], []
    for name, task in tasks.items():
        trial = draw_trial(task, first, varied=False, as_scene=name == AS_SCENE)
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
    for name in ("duck", "sloth", AS_SCENE):
        targets += quality(name, [
            next(iter(replayed(
                draw_trial(tasks[name], seed, varied=True, as_scene=name == AS_SCENE)
            )[0].items()))[1]
            for seed in range(first, first + trials)
        ])  # fmt: skip
    targets += determinism()
    report_targets("replay_soft", targets, note=NOTE, apart_from_mujoco_flex_mm=apart)


def digest() -> str:
    """Hash of the nodes of one duck, and of the robot, at every step of a short replay."""
    from soft_cell import draw_trial, furnished, one_duck

    trial = draw_trial(one_duck(), FIRST_SEED, varied=False)
    found = hashlib.sha256()
    with furnished(trial) as world:
        period_ns = 1e9 / trial.physics.rate_hz
        times = (np.arange(DIGEST_STEPS + 1) * period_ns).astype(np.int64)
        targets, widths = trial.path.joints_at(times), trial.path.width_at(times)
        velocities = np.diff(targets, axis=0) * trial.physics.rate_hz
        world.reset_robot(targets[0], float(widths[0]))
        for step in range(DIGEST_STEPS):
            world.robot.command(targets[step + 1], velocities[step], float(widths[step]))
            world.step()
            if step % 8 == 0:
                found.update(world.soft.nodes_m("duck_1").astype(np.float32).tobytes())
                found.update(world.robot.posture()[0].tobytes())
    return found.hexdigest()


def determinism() -> list[Target]:
    """The same bytes again and in another process."""
    same = {digest() for _ in range(REPEATS)}
    command = [sys.executable, __file__, "--digest"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return [
        Target(what=f"different bytes in {REPEATS} repeats", measured=len(same) - 1, limit=0),
        Target(what="another process gives other bytes",
               measured=float({done.stdout.strip()} != same), limit=0),
    ]  # fmt: skip


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
    if sys.argv[1:] == ["--digest"]:
        print(digest())
    else:
        main()
