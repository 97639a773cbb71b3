"""Calibration of physics on the stand-in cell: held-out poses, and friction inside its interval.

Each seed is a laboratory whose friction, masses, forces, joint zeros and cameras nobody knows but
the cell itself. It records probes and trials, the twin localises and calibrates from them, and is
judged on episodes it did not see, against the defaults of ``PhysicsConfig``, which were fixed
before any of this was written. Frictions are compared with the incline test in MuJoCo with the
cell's coefficients, settled poses with what ``standin_settled`` names.

Arguments: number of seeds (10), first seed (3100), rounds of probes (5), trials (0: they
cost five times a probe and show little), workers (2; 0: only record).
Every seed is stored when it is done, under GST_BENCH_WORK (or a folder beside the results), and is
not done again: the benchmark can be stopped and started. Its recordings stay too: who changes the
calibration deletes ``seed_*.json`` and records nothing again.
"""

import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cell_run import START_NS, UNGATED, FileSession
from measure import ROOT, Target, report_targets
from standin_incline import mujoco_friction
from standin_settled import COMPARED, errors_m, settled_poses

from bridge.episode.run_folder import RunFolder
from bridge.sources.standin.cell_file import draw_hidden, load_cell
from bridge.sources.standin.probes import PROBES
from bridge.sources.standin.session import run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.task.task_file import load_task
from bridge.terminal import Output
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics.parameters import FINGER_FRICTION, SURFACE_FRICTION
from twin.calibrate.physics.run import calibrate_physics

SEEDS, FIRST_SEED, ROUNDS, TRIALS, WORKERS = 10, 3100, 5, 0, 2
TASK = "cube_into_box"
PAIRS = (FINGER_FRICTION, SURFACE_FRICTION)


def true_friction(seed: int) -> dict[str, float]:
    """What the pairs of the cell do on an incline, in the cell's own engine."""
    hidden = draw_hidden(load_cell(load_task(TASK).cell), seed)
    return {
        FINGER_FRICTION: mujoco_friction(
            hidden.finger_friction, hidden.object_friction, slab_priority=1, pad=True
        ),
        SURFACE_FRICTION: mujoco_friction(hidden.object_friction, 1.0, slab_priority=1),
    }


def measure_seed(seed: int, folder: Path, rounds: int, trials: int, workers: int) -> dict[str, Any]:
    """Record, calibrate, compare with the truth; a seed that is there already is read."""
    kept = folder / f"seed_{seed}_{rounds}_{trials}.json"
    run = RunFolder.create(folder / f"run_{seed}")
    if kept.is_file():
        row = dict(json.loads(kept.read_text()))
        if "settled" not in row:
            row["settled"] = settled_poses(run, row)
            kept.write_text(json.dumps(row, indent=1) + "\n")
        return row
    started = time.monotonic()
    record(run, seed, rounds, trials)
    recorded_s = time.monotonic() - started
    config = CalibrateConfig(physics=True, workers=workers)
    physics, _ = calibrate_physics(run, config, Output())
    row = {
        "seed": seed,
        "truth": true_friction(seed),
        "parameters": physics["parameters"],
        "held_out": physics["held_out"],
        "promoted": physics["promoted"],
        "errors": physics["errors"],
        "num_evaluations": physics["num_evaluations"],
        "recorded_s": recorded_s,
        "calibrated_s": time.monotonic() - started - recorded_s,
    }
    row["settled"] = settled_poses(run, row)
    kept.write_text(json.dumps(row, indent=1) + "\n")
    return row


def record(run: RunFolder, seed: int, rounds: int, trials: int) -> None:
    """Record a session, unless it is there; one that was stopped half-way begins again."""
    if len(run.episodes()) == len(PROBES) * rounds + trials:
        return
    for path in run.episodes():
        path.unlink()
    session = SessionConfig(
        task=TASK, seed=seed, scan=False, trials=trials, probes=rounds, conditions=(UNGATED,)
    )
    run_session(FileSession(run.episodes_dir), session, Output(quiet=True), start_ns=START_NS)


def targets_of(rows: list[dict[str, Any]]) -> list[Target]:
    """The table."""
    needed = int(np.ceil(0.9 * len(rows)))
    poses = [pose for row in rows for pose in row["settled"]]
    targets = []
    for name, text in COMPARED.items():
        before, after = errors_m(poses, name)
        targets += [
            Target(what=f"held-out settled poses, {text}: {label}, share of the defaults'",
                   measured=float(middle(after) / middle(before)), limit=0.5,
                   reference=f"{middle(before) * 1e3:.2f} mm with the defaults, "
                             f"{middle(after) * 1e3:.2f} mm calibrated, {len(after)} poses")
            for label, middle in (("median", np.median), ("mean", np.mean))
        ]  # fmt: skip
    targets += [
        Target(what="calibrations promoted", measured=sum(row["promoted"] for row in rows),
               limit=needed, at_most=False, reference=f"of {len(rows)}"),
    ]  # fmt: skip
    for name in PAIRS:
        found = [row["parameters"][name] for row in rows]
        inside = [
            item["identified"] and item["low"] <= row["truth"][name] <= item["high"]
            for item, row in zip(found, rows, strict=True)
        ]
        half = [(item["high"] - item["low"]) / 2 / item["value"] for item in found]
        targets += [
            Target(what=f"{name}: incline test inside the 95 % interval", measured=sum(inside),
                   limit=needed, at_most=False, reference=f"of {len(rows)}"),
            Target(what=f"{name}: half-width of the interval, median",
                   measured=float(np.median(half)), limit=0.25,
                   reference=f"largest {max(half):.2f}"),
        ]  # fmt: skip
    return targets


def print_kinds(poses: Sequence[dict[str, Any]]) -> None:
    """What each kind of probe was off by: a slide cannot be foreseen as a push can."""
    for kind in sorted({pose["kind"] for pose in poses}):
        mine = [pose for pose in poses if pose["kind"] == kind]
        before, after = (1e3 * np.median(each) for each in errors_m(mine, "shifted"))
        print(
            f"{kind}, {COMPARED['shifted']} [mm]: median {before:.2f} with the defaults, "
            f"{after:.2f} calibrated, {len(mine)} poses"
        )


def main() -> None:
    """Every seed, then the table."""
    given = [int(text) for text in sys.argv[1:]]
    defaults = [SEEDS, FIRST_SEED, ROUNDS, TRIALS, WORKERS]
    seeds, first, rounds, trials, workers = given + defaults[len(given) :]
    folder = Path(os.environ.get("GST_BENCH_WORK", ROOT / "build" / "bench_replay_calibration"))
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in range(first, first + seeds):
        if workers == 0:
            record(RunFolder.create(folder / f"run_{seed}"), seed, rounds, trials)
            continue
        rows.append(measure_seed(seed, folder, rounds, trials, workers))
        row = rows[-1]
        for name, text in COMPARED.items():
            before, after = (1e3 * np.array(each) for each in errors_m(row["settled"], name))
            print(
                f"seed {seed}, settled, {text} [mm]: defaults median {np.median(before):.2f} mean "
                f"{before.mean():.2f}, calibrated {np.median(after):.2f} {after.mean():.2f}"
            )
        told = ", ".join(
            f"{name} {row['truth'][name]:.3f} in [{item['low']:.3f}, {item['high']:.3f}]"
            for name in PAIRS
            for item in [row["parameters"][name]]
        )
        print(f"seed {seed}: {told}; {row['calibrated_s']:.0f} s", flush=True)
    if not rows:
        return
    print_kinds([pose for row in rows for pose in row["settled"]])
    report_targets(
        "replay_calibration",
        targets_of(rows),
        note=f"{TASK}, {rounds} rounds of 4 probes, {trials} trials, seeds from {first}; stand-in",
        rows=rows,
    )


if __name__ == "__main__":
    main()
