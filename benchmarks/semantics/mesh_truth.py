"""Parts of the stand-in cell's meshes by the primitives they are drawn from."""

from collections.abc import Callable

import numpy as np
import table_scene

from bridge.task.meshes import solids
from bridge.task.meshes.catalogue import basket_mesh, toy_mesh
from bridge.task.meshes.solids import mesh_of
from bridge.task.meshes.toys import DESIGNS, RIM_M
from twin.scene.semantics.part_segmentation import PartsConfig, find_parts

INNER_M, WALL_M = (0.24, 0.19, 0.085), 0.008
SIDES = (-1.0, 1.0)


def duck_part(p: np.ndarray) -> np.ndarray:
    """Nearest primitive of the duck, in its natural frame."""
    body = np.minimum.reduce(
        [
            solids.ellipsoid(p, (-0.004, 0.0, -0.008), (0.031, 0.0235, 0.0205)),
            solids.capsule(p, (-0.026, 0.0, 0.0), (-0.034, 0.0, 0.010), 0.008, 0.004),
            *(
                solids.ellipsoid(p, (-0.008, s * 0.0215, -0.004), (0.016, 0.0045, 0.010))
                for s in SIDES
            ),
        ]
    )
    head = np.minimum(
        solids.ellipsoid(p, (0.016, 0.0, 0.0205), (0.0150, 0.0145, 0.0145)),
        solids.ellipsoid(p, (0.0315, 0.0, 0.0170), (0.0085, 0.0085, 0.0038)),
    )
    return np.array(["body", "head"])[np.argmin([body, head], axis=0)]


def sloth_part(p: np.ndarray) -> np.ndarray:
    """Nearest primitive of the sloth, in its natural frame."""
    body = np.minimum.reduce(
        [
            solids.ellipsoid(p, (0.027, 0.0, 0.000), (0.024, 0.0260, 0.0225)),
            solids.ellipsoid(p, (-0.040, 0.0, 0.000), (0.026, 0.0280, 0.0225)),
            solids.capsule(p, (0.027, 0.0, -0.001), (-0.040, 0.0, -0.001), 0.0155, 0.0155),
        ]
    )
    head = np.minimum(
        solids.ellipsoid(p, (0.060, 0.0, 0.0085), (0.0220, 0.0240, 0.0235)),
        solids.ellipsoid(p, (0.0815, 0.0, 0.0050), (0.0060, 0.0085, 0.0065)),
    )
    limbs = []
    for s in SIDES:
        arm = (0.026, s * 0.018, -0.006), (0.050, s * 0.0415, -0.0115)
        leg = (-0.043, s * 0.018, -0.008), (-0.066, s * 0.0400, -0.0110)
        limbs += [solids.capsule(p, *arm, 0.0120, 0.0100), solids.capsule(p, *leg, 0.0130, 0.0110)]
    nearest = np.argmin([body, head, np.minimum.reduce(limbs)], axis=0)
    return np.array(["body", "head", "limbs"])[nearest]


def basket_part(p: np.ndarray) -> np.ndarray:
    """Part of the basket by where its design puts it."""
    top = INNER_M[2] + WALL_M
    part = np.full(len(p), "walls", dtype="<U6")
    over = (np.abs(p[:, 0]) < INNER_M[0] / 2) & (np.abs(p[:, 1]) < INNER_M[1] / 2)
    part[(p[:, 2] < WALL_M + 0.003) & over] = "floor"
    part[p[:, 2] > top - RIM_M] = "rim"
    part[p[:, 2] > top + RIM_M] = "handle"
    return part


def part_ious() -> dict[str, dict[str, float]]:
    """IoU of every part of duck, sloth and basket, from the fused Gaussians of twelve views."""
    found = {}
    for name, truth in (("duck", duck_part), ("sloth", sloth_part)):
        design = DESIGNS[name]
        vertices, _ = mesh_of(design.solid, design.low_m, design.high_m, design.spacing_m)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        mesh = toy_mesh(name, tuple(float(extent) for extent in high - low))
        bottom = float(mesh.vertices_m[:, 2].min())
        found[name] = _ious(
            mesh.vertices_m - [0.0, 0.0, bottom],
            mesh.triangles,
            name,
            lambda p, shift=(low + high) / 2 + [0.0, 0.0, bottom], f=truth: f(p + shift),
        )
    basket = basket_mesh(INNER_M, WALL_M)
    found["basket"] = _ious(basket.vertices_m, basket.triangles, "basket", basket_part)
    return found


def _ious(
    vertices: np.ndarray,
    triangles: np.ndarray,
    label: str,
    truth: Callable[[np.ndarray], np.ndarray],
) -> dict[str, float]:
    piece = table_scene.Piece(1, "", (0.6, 0.45, 0.3), vertices, triangles)
    world = table_scene.make_world([table_scene.table(), piece], num_train=12, num_held_out=0)
    p = world.cloud.means_m[world.true_instances() == 1].astype(np.float64)
    part = truth(p)
    masks = find_parts(p, label, 0.004, PartsConfig()).masks
    nothing = np.zeros(len(p), dtype=bool)
    return {
        name: table_scene.iou(masks.get(name, nothing), part == name)
        for name in sorted(set(part.tolist()))
    }
