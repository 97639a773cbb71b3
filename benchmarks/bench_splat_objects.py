"""Objects as closed shapes: a cube, an open box, a duck and what the cell has more.

Ray cast: 20 views on half a sphere at 0.5 m or more, depth noise 1 mm (z / 0.5 m)^2, exact poses
and masks, 320 x 240. Reference in the same run: the convex hull of the measured points, without
carving. Scanned: the same objects in scans of the stand-in cell, with its wrong poses, biased
depth, JPEG and masks by localisation. First argument: number of scans of each task.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import sys
import time
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from measure import ROOT, Target, report_targets

NUM_VIEWS, NOISE = 20, 0.004
BASKET_INNER_M = (0.26, 0.20, 0.08)
TASKS = ("cube_into_box", "sloth_into_basket", "five_ducks_into_basket")
NUM_SCANS = 3
FIRST_SEED = 1_000_500
"""Of the scans; nothing was tuned on these."""
NOTE = (
    f"{NUM_VIEWS} ray-cast views, 320 x 240, noise 1 mm (z / 0.5 m)^2, exact poses, CPU time; "
    "then scans of the stand-in cell as it comes"
)


def known_meshes() -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """Vertices, faces and volume of each thing, standing on z = 0."""
    import cast_views

    from bridge.task.meshes.catalogue import basket_mesh, toy_mesh
    from twin.scene.shape.mesh import volume_m3

    box = cast_views.TASK.objects["box"]
    found = {
        "4 cm cube": (*cast_views.cube_mesh(), 0.04**3),
        "open box": (
            *cast_views.open_box_mesh(),
            float(np.prod(box.size_m) - np.prod(box.inner_m)),
        ),
    }
    toys = {
        "duck": toy_mesh("duck", (0.07, 0.05, 0.06)),
        "sloth": toy_mesh("sloth", (0.16, 0.10, 0.055)),
        "basket": basket_mesh(BASKET_INNER_M, 0.006),
    }
    for name, mesh in toys.items():
        vertices = mesh.vertices_m - [0.0, 0.0, mesh.vertices_m[:, 2].min()]
        found[name] = (vertices, mesh.triangles, volume_m3(vertices, mesh.triangles))
    return found


def measure(name: str, vertices: np.ndarray, faces: np.ndarray, volume: float) -> list[Target]:
    import cast_views

    from twin.scene.shape.reconstruct import reconstruct

    reach = float(np.ptp(vertices, axis=0).max())
    middle = [0.0, 0.0, float(vertices[:, 2].max()) / 2]
    poses = cast_views.around(middle, NUM_VIEWS, max(0.5, 2.2 * reach))
    views = cast_views.cast([(vertices, faces), cast_views.table()], poses, noise=NOISE)
    start = time.process_time()
    shape = reconstruct(views, 0.0)
    seconds = time.process_time() - start
    mean, far = cast_views.mean_error_m((shape.vertices_m, shape.faces), (vertices, faces))
    ratio = shape.volume_m3 / volume
    rows = [
        Target(what=f"{name}: watertight", measured=float(shape.is_watertight), limit=1.0,
               at_most=False),
        Target(what=f"{name}: mean error", measured=mean * 1e3, limit=2.0, unit="mm",
               reference=f"95 % below {far * 1e3:.2f} mm"),
        Target(what=f"{name}: volume off by", measured=abs(ratio - 1) * 100, limit=8.0, unit="%"),
        Target(what=f"{name}: time", measured=seconds, limit=2.0, unit="s"),
    ]  # fmt: skip
    return rows


def scanned(task_names: Sequence[str], seeds: Sequence[int]) -> list[Target]:
    """The objects of some tasks out of scans of the cell: medians over scans and equal objects."""
    import scan_objects

    scores: dict[str, list[scan_objects.ShapeScore | None]] = {}
    turned: dict[str, list[scan_objects.TurnedScore | None]] = {}
    for task_name, seed in product(task_names, seeds):
        scan = scan_objects.take_scan(task_name, seed)
        for key in scan.start.task.objects:
            name = key.split("_")[0]
            scores.setdefault(name, []).append(scan_objects.score_shape(scan, key))
            turned.setdefault(name, []).append(scan_objects.score_turned(scan, key))
    rows = turned_rows(turned)
    for name, found in scores.items():
        rows += scan_rows(name, found)
    return rows


def turned_rows(turned: Mapping[str, Sequence[Any]]) -> list[Target]:
    """The table's lines for objects turned over; the worst scan counts."""
    rows = []
    for name, scores in turned.items():
        found = [score for score in scores if score is not None]
        for what, limit, unit, value in (
            ("see-through pixels", 1.0, "%", lambda score: 100 * score.see_through),
            ("colour of seen sides off by", 6.0, "/255", lambda score: score.seen_error),
            ("colour of hidden sides off by", 6.0, "/255", lambda score: score.hidden_error),
        ):
            worst = max((value(score) for score in found), default=float("inf"))
            rows.append(
                Target(what=f"{name} turned over: {what}", measured=worst, limit=limit, unit=unit,
                       reference=f"worst of {len(found)} of {len(scores)} scans")
            )  # fmt: skip
    return rows


def scan_rows(name: str, found: Sequence[Any]) -> list[Target]:
    """The table's lines for one object out of scans; one that is missing counts as infinite."""
    errors = [np.inf if s is None else 1e3 * s.mean_error_m for s in found]
    volumes = [np.inf if s is None else 100 * abs(s.volume_ratio - 1) for s in found]
    signed = ", ".join("none" if s is None else f"{100 * s.volume_ratio:.0f}" for s in found[:8])
    closed = [s is not None and s.watertight for s in found]
    rows = [
        Target(what=f"scanned {name}: watertight", measured=float(np.mean(closed)), limit=1.0,
               at_most=False, reference=f"{len(found)} shapes"),
        Target(what=f"scanned {name}: mean error", measured=float(np.median(errors)), limit=2.0,
               unit="mm", reference=f"worst {max(errors):.2f} mm"),
        Target(what=f"scanned {name}: volume off by", measured=float(np.median(volumes)),
               limit=8.0, unit="%", reference=f"{signed} % of the truth, worst {max(volumes):.0f}"),
    ]  # fmt: skip
    return rows


def main() -> None:
    """Measure each thing ray cast, then out of scans."""
    sys.path.insert(0, str(ROOT / "tests" / "twin" / "scene" / "shape"))
    count = int(sys.argv[1]) if len(sys.argv) > 1 else NUM_SCANS
    rows = [row for name, mesh in known_meshes().items() for row in measure(name, *mesh)]
    rows += scanned(TASKS, range(FIRST_SEED, FIRST_SEED + count))
    report_targets("splat_objects", rows, note=NOTE)


if __name__ == "__main__":
    main()
