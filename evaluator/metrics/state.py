"""How far apart two places of one object are: position, rotation modulo its symmetry, extents."""

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
    """Every rotation that lays the axes onto each other: the rotation group of the cube."""
    turns = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), order] = signs
            if np.linalg.det(R) > 0:
                turns.append(R)
    turns.sort(key=lambda R: -float(np.trace(R)))
    return np.stack(turns)


def turn_between_rad(
    R_base_first: Float[np.ndarray, "3 3"],
    R_base_second: Float[np.ndarray, "3 3"],
    turns: Float[np.ndarray, "num_turns 3 3"],
) -> float:
    """Return the smallest angle between two rotations of an object that looks alike after turns.

    Range: 0 rad to pi, 0 is perfect.

    Args:
        turns: What cannot be seen, in the object's frame.
    """
    return float(se3.rotation_angle_rad(R_base_first.T @ (R_base_second @ turns)).min())


def soft_box(
    nodes_m: Float[np.ndarray, "num_nodes 3"],
    T_base_object: Float[np.ndarray, "4 4"],
    rest_nodes_m: Float[np.ndarray, "num_nodes 3"],
    T_base_rest: Float[np.ndarray, "4 4"],
    size_m: tuple[float, float, float],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return middle and extents of the box around a soft object, along the axes of its pose [m].

    Nodes may reach beyond the surface or stay within it, so they only tell the change: each extent
    is that at rest times what the nodes' extent has become, and the middle moves as theirs does.

    Args:
        nodes_m: Its nodes now, in the base frame.
        T_base_object: Its pose now; the origin is the middle at rest.
    """
    now = se3.apply(se3.invert(T_base_object), nodes_m)
    rest = se3.apply(se3.invert(T_base_rest), rest_nodes_m)
    shift = (now.max(axis=0) + now.min(axis=0) - rest.max(axis=0) - rest.min(axis=0)) / 2
    extents = np.ptp(now, axis=0) / np.ptp(rest, axis=0) * np.array(size_m)
    return se3.apply(T_base_object, shift), extents


def extents_difference_m(
    first_m: Float[np.ndarray, "3"], second_m: Float[np.ndarray, "3"]
) -> float:
    """Return the largest difference of an extent [m]. Range: 0 m and up, 0 is perfect.

    Args:
        second_m: Its extents in the other, along the same axes [m].
    """
    return float(np.abs(first_m - second_m).max())
