"""Parts, keypoints and questions on scenes rebuilt from scans of the stand-in cell."""

from collections.abc import Callable

import mesh_truth
import numpy as np
import scan_objects
from measure import Target

from bridge.geometry import se3
from bridge.task.meshes.solids import mesh_of
from bridge.task.meshes.toys import DESIGNS
from bridge.task.task_file import ObjectModel
from twin.scene.gaussians import concatenate
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.semantics.describe import scene_by_default
from twin.scene.semantics.language import query
from twin.scene.semantics.result import Instance, SemanticScene
from twin.scene.shape.reconstruct import ObjectShape

SEED = 1_000_500
ITERATIONS = 60
"""Images the Gaussians are fitted to: the scene is rebuilt, not only fused."""
TASKS = ("sloth_into_basket", "five_ducks_into_basket")
QUESTIONS = {
    "sloth_into_basket": {
        "sloth": (("sloth",), None),
        "the brown toy": (("sloth",), None),
        "head of the sloth": (("sloth",), "head"),
        "rim of the basket": (("basket",), "rim"),
        "the container": (("basket",), None),
    },
    "five_ducks_into_basket": {
        "all ducks": (("duck_1", "duck_2", "duck_3", "duck_4", "duck_5"), None),
        "a duck's head": (("duck_1", "duck_2", "duck_3", "duck_4", "duck_5"), "head"),
        "the basket": (("basket",), None),
        "handle of the basket": (("basket",), "handle"),
    },
}
"""What is asked, and which objects (and which part of them) are meant."""
PART_OF: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "duck": mesh_truth.duck_part,
    "sloth": mesh_truth.sloth_part,
}
HEADS_M = {"duck": (0.016, 0.0, 0.0205), "sloth": (0.060, 0.0, 0.0085)}
"""Middle of the head where the design puts it."""


def targets() -> list[Target]:
    """IoU of parts, distance of keypoints, right answers."""
    ious: dict[str, dict[str, list[float]]] = {}
    away_mm: dict[str, list[float]] = {}
    answers: list[bool] = []
    for task_name in TASKS:
        scan = scan_objects.take_scan(task_name, SEED, iterations=ITERATIONS)
        scene, rows = _semantics(scan)
        number = {key: index for index, key in enumerate(rows, start=1)}
        answers += [
            _is_right(scene, text, {number.get(key, -1) for key in keys}, part)
            for text, (keys, part) in QUESTIONS[task_name].items()
        ]
        for key, (ids, p_object) in rows.items():
            model, item = scan.start.task.objects[key], scene.instance(number[key])
            name = key.split("_")[0]
            truth = true_part(model, p_object)
            for part in sorted(set(truth.tolist())):
                found = item.parts.get(part, np.zeros(len(scene.labels), dtype=bool))[ids]
                right = truth == part
                iou = float((found & right).sum() / max((found | right).sum(), 1))
                ious.setdefault(name, {}).setdefault(part, []).append(iou)
            away = _keypoint_mm(model, item, scan.start.Ts_base_object[key])
            away_mm.setdefault(name, []).append(away)
    return _rows(ious, away_mm, answers)


def _semantics(
    scan: scan_objects.Scanned,
) -> tuple[SemanticScene, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """The scene's semantics; per object its rows, and their places in its true frame."""
    background, objects = scan_objects.whole_scene(scan.apart())
    cloud = concatenate([background, *objects.values()])
    names = np.repeat(["", *objects], [len(background), *map(len, objects.values())])
    known = {key: names == key for key in objects}
    rasteriser = Rasteriser(RasterConfig(threads=1))
    rows = {}
    for key, mask in known.items():
        ids = np.flatnonzero(mask)
        T = se3.invert(scan.start.Ts_base_object[key])
        rows[key] = (ids, se3.apply(T, cloud.means_m[ids].astype(np.float64)))
    surfaces = {
        key: se3.apply(scan.poses[key], shape.vertices_m)
        for key, shape in scan.shapes.items()
        if isinstance(shape, ObjectShape)
    }
    scene = scene_by_default(cloud, [], rasteriser, known=known, surfaces_m=surfaces)
    return scene, rows


def true_part(model: ObjectModel, p_object: np.ndarray) -> np.ndarray:
    """Part of each point by the primitives the mesh is drawn from."""
    if model.mesh not in PART_OF:
        return mesh_truth.basket_part(p_object)
    low, high = _extent(model.mesh)
    scale = np.array(model.size_m) / (high - low)
    return PART_OF[model.mesh](p_object / scale + (low + high) / 2)


def _extent(name: str) -> tuple[np.ndarray, np.ndarray]:
    design = DESIGNS[name]
    vertices, _ = mesh_of(design.solid, design.low_m, design.high_m, design.spacing_m)
    return vertices.min(axis=0), vertices.max(axis=0)


def _keypoint_mm(model: ObjectModel, item: Instance, T_base_object: np.ndarray) -> float:
    """How far the head, or the opening, is from where it is."""
    if model.mesh in HEADS_M:
        low, high = _extent(model.mesh)
        scale = np.array(model.size_m) / (high - low)
        place, name = (np.array(HEADS_M[model.mesh]) - (low + high) / 2) * scale, "head"
    else:
        place, name = np.array([0.0, 0.0, model.size_m[2]]), "opening"
    found = item.keypoints_m.get(name)
    if found is None:
        return np.inf
    return 1e3 * float(np.linalg.norm(se3.apply(T_base_object, place[None])[0] - found))


def _is_right(scene: SemanticScene, text: str, wanted: set[int], part: str | None) -> bool:
    answer = query(scene, text)
    if part is not None:
        return {key for key, value in answer.parts.items() if value > 0} == {
            (number, part) for number in wanted
        }
    return {number for number, value in answer.objects.items() if value > 0} == wanted


def _rows(
    ious: dict[str, dict[str, list[float]]], away_mm: dict[str, list[float]], answers: list[bool]
) -> list[Target]:
    rows, every = [], []
    for name, parts in ious.items():
        means = {part: float(np.mean(values)) for part, values in parts.items()}
        every += list(means.values())
        rows.append(
            Target(
                what=f"rebuilt {name}: parts, mean IoU",
                measured=float(np.mean(list(means.values()))),
                limit=0.5,
                at_most=False,
                reference=", ".join(f"{part} {value:.2f}" for part, value in means.items()),
            )
        )
        what = "opening" if name == "basket" else "head"
        rows.append(
            Target(
                what=f"rebuilt {name}: keypoint {what} off by, median",
                measured=float(np.median(away_mm[name])),
                limit=15.0,
                unit="mm",
                reference=f"worst {max(away_mm[name]):.1f} mm of {len(away_mm[name])}",
            )
        )
    rows.append(
        Target(
            what="rebuilt scenes: mean part IoU",
            measured=float(np.mean(every)),
            limit=0.6,
            at_most=False,
        )
    )
    rows.append(
        Target(
            what="rebuilt scenes: questions answered right",
            measured=100 * float(np.mean(answers)),
            limit=100.0,
            unit="%",
            at_most=False,
            reference=f"{sum(answers)} of {len(answers)}",
        )
    )
    return rows
