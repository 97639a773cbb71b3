"""Where objects start in the stand-in cell, from its own noisy cameras; truth known.

Each trial draws a laboratory (wrong camera poses, joint offsets, depth bias) and a start from the
development seeds, and takes three frames of each camera. The reference is the middle of the points
that have the object's colour, from the same frames. First argument: number of trials.
"""

import sys
import time
from collections.abc import Sequence

import numpy as np
from measure import Target, report_targets

TRIALS, TOY_TRIALS = 50, 20
NOTE = "development seeds, 3 frames of wrist and side camera, 320 x 240; wall time"


def turn_deg(T: np.ndarray, T_true: np.ndarray, period_deg: float) -> float:
    """Angle between two poses, modulo turns about the object's vertical."""
    from scipy.spatial.transform import Rotation

    R = T[:3, :3].T @ T_true[:3, :3]
    turns = np.arange(0.0, 360.0 - 1e-9, period_deg)
    spun = [Rotation.from_matrix(R @ Rotation.from_euler("z", t, degrees=True).as_matrix())
            for t in turns]  # fmt: skip
    return float(np.degrees(min(rotation.magnitude() for rotation in spun)))


def measure(
    task_name: str, trials: int
) -> tuple[dict[str, list[tuple[float, float, float]]], list[float], list[float]]:
    """Per object (mm, degrees, mm of the reference); seconds a call; errors of soft extents [mm].

    What was not found counts as infinitely wrong.
    """
    from localise_cell import look_at_start

    from bridge.sources.standin.cell_file import load_cell
    from bridge.task.task_file import load_task
    from twin.scene.localise.objects import localise_objects
    from twin.scene.localise.points import fuse_stationary, object_points
    from twin.scene.shape.known import yaw_period_rad

    first = load_cell(load_task(task_name).cell).development_seeds[0]
    errors: dict[str, list[tuple[float, float, float]]] = {}
    seconds, extents_mm = [], []
    for seed in range(first, first + trials):
        start = look_at_start(task_name, seed)
        before = time.monotonic()
        found = localise_objects(start.frames, start.task)
        seconds.append(time.monotonic() - before)
        views = fuse_stationary(start.frames, 3, 8, start.task)
        for key, T_true in start.Ts_base_object.items():
            model, item = start.task.objects[key], found[key]
            groups = object_points(views, model)
            middle = np.median(groups[0].p_base, axis=0) if groups else np.full(3, np.nan)
            plain = float(np.linalg.norm(middle[:2] - T_true[:2, 3])) * 1e3
            if item.T_base_object is None:
                print(f"  seed {seed}: {key} not found: {item.reason}")
                errors.setdefault(key, []).append((np.inf, np.inf, plain))
                continue
            off = float(np.linalg.norm(item.T_base_object[:3, 3] - T_true[:3, 3])) * 1e3
            period = 360.0 if model.soft else float(np.degrees(yaw_period_rad(model)))
            errors.setdefault(key, []).append(
                (off, turn_deg(item.T_base_object, T_true, period), plain)
            )
            if model.soft:
                seen = np.array(item.detail["soft_shape"]["extents_m"])
                extents_mm += list(np.abs(seen - start.extents_m[key]) * 1e3)
    return errors, seconds, extents_mm


def rows_of(
    name: str, rows: Sequence[tuple[float, float, float]], seconds: Sequence[float]
) -> list[Target]:
    """The table's lines for one object."""
    mm, degrees, plain = np.array(rows).T
    reference = f"middle of its points {np.median(plain):.1f} mm"
    return [
        Target(what=f"{name}: median error", measured=float(np.median(mm)), limit=3.0, unit="mm",
               reference=reference),
        Target(what=f"{name}: 95th percentile", measured=float(np.percentile(mm, 95)), limit=8.0,
               unit="mm", reference=f"{len(mm)} poses"),
        Target(what=f"{name}: median turn", measured=float(np.median(degrees)), limit=3.0,
               unit="deg", reference=f"95th percentile {np.percentile(degrees, 95):.1f} deg"),
        Target(what=f"{name}: time for each object", measured=max(seconds), limit=1.0, unit="s",
               reference=f"median {np.median(seconds):.2f} s"),
    ]  # fmt: skip


def main() -> None:
    """The cube task's objects, then the toys."""
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS
    targets = []
    for task, count in (
        ("cube_into_box", trials),
        ("sloth_into_basket", min(trials, TOY_TRIALS)),
        ("five_ducks_into_basket", min(trials, TOY_TRIALS)),
    ):
        errors, seconds, extents_mm = measure(task, count)
        each = [value / len(errors) for value in seconds]
        ducks = [row for key, rows in errors.items() if key.startswith("duck") for row in rows]
        named = {key: rows for key, rows in errors.items() if not key.startswith("duck")}
        for key, rows in {**named, **({"ducks": ducks} if ducks else {})}.items():
            targets += rows_of(f"{task}, {key}", rows, each)
        if extents_mm:
            targets.append(
                Target(what=f"{task}: extents off by, median", limit=10.0, unit="mm",
                       measured=float(np.median(extents_mm)))
            )  # fmt: skip
    report_targets("splat_localise", targets, note=NOTE)


if __name__ == "__main__":
    main()
