"""A policy in the loop: steps of 100 ms with two pictures, against composing and drawing anew.

Usage: python benchmarks/bench_policy_loop.py RUN (a demo's run folder; nothing is written into it).
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path
from shutil import copytree

import numpy as np
from measure import Target, cpu_seconds, report_targets

from bridge.episode.run_folder import RunFolder
from twin.policies.environment import TwinEnv
from twin.robot.posture import Posture
from twin.scene.raster.backend import open_rasteriser

STEP_S, SIZE, REPEATS, STEPS = 0.1, (224, 224), 20, 60
REAL_TIME, PER_CORE = 4.0, 8.0
RASTERISER = open_rasteriser()


def anew(env: TwinEnv) -> dict[str, np.ndarray]:
    """Both pictures as a replay draws them: composed from all parts, with depth."""
    cell, cameras = env._opened(), env._cameras
    joints, width_m = cell.posture()
    posture = Posture(joints_rad=joints, width_m=width_m)
    cloud = cameras._drawable.at(cell.places(), cell.nodes_m(), posture)
    T_base_tcp, backdrop = cell.robot.T_base_tcp(joints), cameras._drawable.parts.backdrop
    found = {}
    for name, place in cameras.viewpoints.items():
        T = place.T(T_base_tcp)
        view = RASTERISER.view(cloud, place.camera, T)
        found[name] = backdrop.behind(view, place.camera, T).image_u8()
    return found


def main() -> int:
    """Measure, print and store."""
    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder(Path(copytree(sys.argv[1], Path(folder) / "run")))
        env = TwinEnv(run.path, size=SIZE)
        start = env.reset()[0]["agent_pos"].astype(float)
        rng = np.random.default_rng(0)

        def step() -> None:
            env.step(start + np.append(rng.normal(0.0, 0.02, len(start) - 1), 0.0))

        step()
        cameras, cell = env._cameras, env._opened()
        own = cameras.draw(cell)
        reference = anew(env)
        off = max(int(np.abs(own[n].astype(int) - reference[n].astype(int)).max()) for n in own)
        cpu = statistics.median(cpu_seconds(step, repeats=REPEATS))
        drawn_anew = statistics.median(cpu_seconds(lambda: anew(env), repeats=REPEATS))
        drawn = statistics.median(cpu_seconds(lambda: cameras.draw(cell), repeats=REPEATS))
        began = time.perf_counter()
        for _ in range(STEPS):
            step()
        factor = STEPS * STEP_S / (time.perf_counter() - began)
    return report_targets(
        "policy_loop",
        [
            Target(what="faster than real time, all cores", measured=factor, limit=REAL_TIME,
                   unit="x", at_most=False),
            Target(what="steps of 100 ms a core and second", measured=1 / cpu, limit=PER_CORE,
                   at_most=False, reference=f"CPU {cpu * 1e3:.0f} ms a step"),
            Target(what="pictures against drawing anew", measured=drawn_anew / drawn, limit=1.0,
                   unit="x", at_most=False, reference=f"{drawn_anew * 1e3:.0f} ms of CPU"),
            Target(what="largest difference from drawing anew", measured=off, limit=1, unit="/255"),
        ],
        note="two cameras of 224 px, 10 Hz, rigid task of a demo run",
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
