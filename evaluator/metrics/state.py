"""How far apart two poses of one object are in rotation, modulo its symmetry."""

from functools import cache
from itertools import permutations, product

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.task_file import BASKET, ObjectModel

ALIKE = 1e-6
"""Sides that differ by a smaller share are equal."""


def turns_alike(model: ObjectModel) -> Float[np.ndarray, "num_turns 3 3"]:
    """Return the turns after which an object looks the same; the first is none at all.

    Boxes have one colour and no front: every turn that exchanges equal sides, 24 of a cube, 8 of a
    square prism, else 4. An open box or a basket stays upright: 4 turns when square, else 2. Toys
    and scanned objects have a front: none.
    """
    everything = _box_turns()
    if model.symmetry == "cube":
        return everything
    same = [
        R for R in everything if np.allclose(np.abs(R) @ model.size_m, model.size_m, rtol=ALIKE)
    ]
    if model.shape == "box":
        return np.stack(same)
    if model.shape == "open_box" or model.mesh == BASKET:
        return np.stack([R for R in same if R[2, 2] == 1])
    return np.eye(3)[None]


@cache
def _box_turns() -> Float[np.ndarray, "24 3 3"]:
    """Rotations that lay the axes onto each other, none first; SciPy loads half a second."""
    signs = [np.diag(each) for each in product((1.0, -1.0), repeat=3)]
    turns = np.array(
        [sign @ np.eye(3)[[*axes]] for axes in permutations(range(3)) for sign in signs]
    )
    turns = turns[np.linalg.det(turns) > 0]  # the others are mirrored
    return np.asarray(turns[np.argsort(-turns.trace(axis1=1, axis2=2), kind="stable")])


def turn_between_rad(
    R_base_first: Float[np.ndarray, "3 3"],
    R_base_second: Float[np.ndarray, "3 3"],
    turns: Float[np.ndarray, "num_turns 3 3"],
) -> float:
    """Return the smallest angle between two rotations of an object that looks alike after turns.

    Range: 0 rad to pi, 0 is perfect.
    """
    return float(se3.rotation_angle_rad(R_base_first.T @ (R_base_second @ turns)).min())
