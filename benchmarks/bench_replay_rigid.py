"""Rigid replay in each engine: physics alone and complete, and how far a held cube slips.

24 randomised grasps of a 30 mm to 40 mm cube (pose, mass, friction, force). The trajectory comes
from waypoints without joints, so inverse kinematics is solved; clearance is measured 60 times per
second; the episode is written. Times are CPU time of one core, in this process.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import hashlib
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from measure import ROOT, Target, report_targets

GRASPS = int(os.environ.get("GST_BENCH_GRASPS", "24"))
ENGINES = ("pybullet", "mujoco")
REPEATS = int(os.environ.get("GST_BENCH_REPEATS", "100"))
NOTE = (
    f"{GRASPS} randomised grasps, 12 s trajectories, one core, CPU time; slip of the cube in the "
    "tool's frame while it is carried"
)


def randomised(rng: np.random.Generator) -> tuple[object, object, object]:
    """A scene, a plan that grasps the cube a little wrong, and the physics it happens in."""
    from scripted_plans import downward, pick_and_place, scene_of_test

    from bridge.geometry import se3
    from twin.physics.config import PhysicsConfig
    from twin.replay.config import ReplayConfig

    scene = scene_of_test()
    yaw = rng.uniform(-0.7, 0.7)
    q = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    p = np.array([rng.uniform(0.42, 0.56), rng.uniform(-0.22, -0.08), 0.02])
    model = replace(scene.task.objects["cube"], mass_kg=float(rng.uniform(0.03, 0.1)))
    task = replace(scene.task, objects={**scene.task.objects, "cube": model})
    scene = replace(
        scene, task=task, Ts_base_object={**scene.Ts_base_object, "cube": se3.transform_from(q, p)}
    )
    offset = (*rng.uniform(-0.004, 0.004, 2).tolist(), 0.0)
    plan = pick_and_place(scene, grasp_offset_m=offset, pace=1.0)
    turn = downward(yaw + float(rng.uniform(-0.08, 0.08)))
    tau = tuple(replace(w, q_wxyz=turn) if w.t_ns <= 4_600_000_000 else w for w in plan.tau)
    physics = PhysicsConfig(
        object_friction=float(rng.uniform(0.5, 1.0)), grip_force_N=float(rng.uniform(8.0, 30.0))
    )
    return scene, replace(plan, tau=tau), replace(ReplayConfig(), physics=physics)


def slip_m(result: object) -> float:
    """Largest motion of the cube in the tool's frame from the lift to the end of the carry."""
    from bridge.geometry import se3

    cube = result.Ts_base_object["cube"]
    held = result.finger_contact["cube"] & (cube[:, 2, 3] > 0.06)
    if held.sum() < 30:
        return float("inf")
    T = se3.invert(result.Ts_base_tcp[held]) @ cube[held]
    return float(np.linalg.norm(T[:, :3, 3] - T[0, :3, 3], axis=1).max())


def physics_alone(scene: object, plan: object, config: object) -> tuple[float, float]:
    """CPU seconds of the simulation of a path that is known, and how long it lasts."""
    from twin.replay.dynamics import simulate
    from twin.replay.path import path_of_plan
    from twin.robot.collision import hulls_of
    from twin.robot.model import load_robot

    robot = load_robot(scene.urdf)
    path, _, _ = path_of_plan(plan, robot)
    start = time.process_time()
    states = simulate(path, scene, hulls_of(robot), config)
    return time.process_time() - start, float(states.stamps_ns[-1]) * 1e-9


def complete(scene: object, plan: object, config: object, folder: Path) -> tuple[float, object]:
    """CPU seconds from the plan to the written episode, and the result."""
    from bridge.episode.metadata import Derived, EpisodeInfo
    from twin.replay.output import ReplayOrigin, write_replay
    from twin.replay.verdict import replay_plan

    start = time.process_time()
    result = replay_plan(plan, scene, config)
    origin = ReplayOrigin(
        info=EpisodeInfo(id="bench", kind="trial"),
        derived=Derived(kind="replay", source_episode="bench", source_sha256=""),
        cell="bench",
        start_ns=10**18,
        urdf=scene.urdf,
        stages=plan.stages,
        gripper=(),
        end_ns=plan.tau[-1].t_ns,
    )
    write_replay(folder / f"{time.monotonic_ns()}.mcap", result, plan, origin)
    return time.process_time() - start, result


def digest(engine: str, repeats: int) -> str:
    """Hash of one replay, which is the same each time, or the hashes that differ."""
    from twin.replay.verdict import replay_plan

    rng = np.random.default_rng(0)
    scene, plan, config = randomised(rng)
    short = replace(config, settle_after_s=0.1, engine=engine)
    found = set()
    for _ in range(repeats):
        result = replay_plan(plan, scene, short)
        rows = [result.joints_rad, result.width_m, *result.Ts_base_object.values()]
        rows.append(result.clearance_m)
        found.add(hashlib.sha256(b"".join(row.tobytes() for row in rows)).hexdigest())
    return " ".join(sorted(found))


def other_process(engine: str) -> str:
    """The hash that a fresh process finds."""
    command = [sys.executable, __file__, "--digest", engine]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.strip()


@dataclass
class Measured:
    """Of one engine, a value for each grasp."""

    alone: list[float] = field(default_factory=list)
    """Physics, times real time."""
    whole: list[float] = field(default_factory=list)
    """The complete replay, times real time."""
    slips_mm: list[float] = field(default_factory=list)
    ends_m: list[object] = field(default_factory=list)
    """Where the cube lies in the end."""
    placed: int = 0

    def targets(self, engine: str) -> list[Target]:
        """What it must reach."""
        same = digest(engine, REPEATS)
        held = float(np.isfinite(self.slips_mm).sum())
        slip = f"median {np.median(self.slips_mm):.2f}"
        return [
            Target(what=f"{engine}: physics only, median", measured=float(np.median(self.alone)),
                   limit=30.0, unit="x", at_most=False, reference=f"slowest {min(self.alone):.1f}"),
            Target(what=f"{engine}: complete, median", measured=float(np.median(self.whole)),
                   limit=15.0, unit="x", at_most=False, reference=f"slowest {min(self.whole):.1f}"),
            Target(what=f"{engine}: slip, 90 % below", limit=2.0, unit="mm", reference=slip,
                   measured=float(np.percentile(self.slips_mm, 90))),
            Target(what=f"{engine}: held", measured=held, limit=GRASPS, at_most=False),
            Target(what=f"{engine}: placed", measured=self.placed, limit=GRASPS, at_most=False),
            Target(what=f"{engine}: different bytes in {REPEATS} repeats",
                   measured=len(same.split()) - 1, limit=0),
            Target(what=f"{engine}: another process gives other bytes",
                   measured=float(other_process(engine) != same), limit=0),
        ]  # fmt: skip


def main() -> None:
    """Measure all grasps in both engines, then repeat one."""
    found = {engine: Measured() for engine in ENGINES}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(GRASPS + 1):
            scene, plan, config = randomised(np.random.default_rng(seed))
            for engine, of_engine in found.items():
                settings = replace(config, engine=engine)
                seconds, lasted = physics_alone(scene, plan, settings)
                total, result = complete(scene, plan, settings, Path(folder))
                if seed == 0:
                    continue  # what is built once per process
                of_engine.alone.append(lasted / seconds)
                of_engine.whole.append(lasted / total)
                of_engine.slips_mm.append(slip_m(result) * 1e3)
                of_engine.ends_m.append(result.Ts_base_object["cube"][-1, :3, 3])
                of_engine.placed += result.verdict.terminal.value is True
    rows = [target for engine in ENGINES for target in found[engine].targets(engine)]
    first, second = (np.array(found[engine].ends_m) for engine in ENGINES)
    apart_mm = np.linalg.norm(first - second, axis=1) * 1e3
    ratios = np.array(found["mujoco"].whole) / np.array(found["pybullet"].whole)
    rows += [
        Target(what="final place, one engine from the other, median", unit="mm", limit=10.0,
               measured=float(np.median(apart_mm)), reference=f"largest {apart_mm.max():.1f}"),
        Target(what="mujoco against pybullet, complete, median ratio of speeds", unit="x",
               measured=float(np.median(ratios)), limit=15.0 / 55.0, at_most=False),
    ]  # fmt: skip
    setting = {"rate_hz": config.physics.rate_hz, "iterations": config.physics.solver_iterations}
    report_targets("replay_rigid", rows, note=NOTE, setting=setting)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "tests" / "twin" / "replay"))
    if sys.argv[1:2] == ["--digest"]:
        print(digest(sys.argv[2], 1))
    else:
        main()
