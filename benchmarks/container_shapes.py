"""How well a container's stand-ins are the container: panels of the task, parts of the scan.

Points are spread through a band around the true surface, and each stand-in is asked how far they
are from it. Too far is the unsafe direction: a touch is missed. Too near refuses what was free.
Example: .venv/bin/python benchmarks/container_shapes.py RUN TASK
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import coal
import numpy as np

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.meshes.toys import basket_parts
from bridge.task.task_file import ObjectModel, load_task
from twin.replay.clearance.bodies import placed_panels, placement_of
from twin.robot.collision import convex_hull, signed_distance
from twin.scene.shape.files import COLLISION
from twin.scene.shape.mesh import read_mesh

NUM_POINTS = 3000
BAND_M = 0.015
OFF_M = 0.003
"""More than this is more than localisation is off by."""
Pieces = list[tuple[coal.CollisionGeometry, coal.Transform3s]]


def panels_of(model: ObjectModel) -> Pieces:
    """What physics and clearance use."""
    return [(coal.Box(*size), placement_of(T)) for T, size in placed_panels(model, np.eye(4))]


def true_distance_m(model: ObjectModel, points: np.ndarray) -> np.ndarray:
    """Signed distance to the object itself: its mesh's own formula, or its panels."""
    if model.mesh is not None:
        return object_mesh(model).solid(points)
    return distance_m(panels_of(model), points)


def distance_m(pieces: Pieces, points: np.ndarray) -> np.ndarray:
    """Signed distance of points to a union of convex pieces."""
    probe = coal.Sphere(1e-6)
    return np.array(
        [
            min(
                signed_distance(probe, coal.Transform3s(np.eye(3), p), shape, placement)
                for shape, placement in pieces
            )
            for p in points
        ]
    )


def band(model: ObjectModel, rng: np.random.Generator) -> np.ndarray:
    """Points around the surface, above the underside it stands on."""
    x, y, z = model.size_m
    reach = np.array([x / 2, y / 2, z / 2 + 0.03]) + BAND_M
    middle = np.array([0.0, 0.0, z / 2 + 0.02])
    points = middle + rng.uniform(-reach, reach, (40 * NUM_POINTS, 3))
    points = points[points[:, 2] > OFF_M]
    if model.mesh is None:
        points = points[: 4 * NUM_POINTS]
    near = points[np.abs(true_distance_m(model, points)) < BAND_M]
    return near[:NUM_POINTS]


def row(name: str, pieces: Pieces, points: np.ndarray, truth: np.ndarray) -> dict[str, object]:
    before = time.thread_time()
    off = distance_m(pieces, points) - truth
    micros = (time.thread_time() - before) / len(points) * 1e6
    return {
        "stand-in": name,
        "pieces": len(pieces),
        "mean_off_mm": round(float(np.abs(off).mean()) * 1e3, 2),
        "p95_off_mm": round(float(np.percentile(np.abs(off), 95)) * 1e3, 2),
        "too_far": round(float((off > OFF_M).mean()), 3),
        "too_near": round(float((off < -OFF_M).mean()), 3),
        "cpu_us_per_point": round(micros, 1),
    }


def rows_of(run: RunFolder, model: ObjectModel) -> Sequence[dict[str, object]]:
    points = band(model, np.random.default_rng(0))
    truth = true_distance_m(model, points)
    found = [row("panels of the task", panels_of(model), points, truth)]
    if model.mesh is not None:
        boxes = basket_parts(model.inner_m, model.wall_m)
        pieces: Pieces = [
            (coal.Box(*box.size_m), placement_of(se3.transform_from(box.q_wxyz, box.centre_m)))
            for box in boxes
        ]
        found.append(row("parts of the design", pieces, points, truth))
    folder = run.scene_dir / "objects" / model.id / COLLISION
    parts = [read_mesh(path) for path in sorted(folder.glob("*.ply"))]
    if parts:
        pieces = [(convex_hull(vertices), coal.Transform3s()) for vertices, _ in parts]
        found.append(row("parts of the scan", pieces, points, truth))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="rebuilt run of the stand-in cell")
    parser.add_argument("task", help="its task")
    given = parser.parse_args()
    task, run = load_task(given.task), RunFolder.open(given.run)
    for name in task.containers:
        for item in rows_of(run, task.objects[name]):
            print(json.dumps({"object": name, **item}))


if __name__ == "__main__":
    main()
