"""The cell's light on arm and objects: how bright a surface is by the way it faces.

A link that turns shows the same paint in another light. Seen in several postures, its colours are
paint times light, and light depends on where a surface faces in the robot's base frame: spherical
harmonics up to degree 2, enough for matte surfaces (Ramamoorthi and Hanrahan 2001). One light for
all links and all channels; shadows and gloss are left out. Links keep their paint, and are lit
anew in each posture; sides of objects that nobody saw are as bright as it makes them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bridge.geometry import se3
from twin.scene.gaussians import GaussianCloud, as_float32

NUM_COEFFICIENTS = 9
DIMMEST = 0.1
"""No surface is drawn darker than this share of the mean light."""
RIDGE = 1e-3
"""Pull towards even light, in mean squared brightness of what was seen."""
ROUNDS = 30


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """Brightness by direction, 1 for the mean of what was seen."""

    coefficients: tuple[float, ...] = (1.0, *[0.0] * (NUM_COEFFICIENTS - 1))
    """Of 1, x, y, z, xy, yz, 3 z^2 - 1, xz, x^2 - y^2 of the unit normal, base frame."""

    def brightness(
        self, normals: Float[np.ndarray, "num_points 3"]
    ) -> Float[np.ndarray, " num_points"]:
        """How bright surfaces are that face along unit normals, base frame."""
        return np.asarray(np.maximum(_basis(normals) @ np.array(self.coefficients), DIMMEST))

    def on(self, cloud: GaussianCloud) -> GaussianCloud:
        """Flat Gaussians in this light; their normals are their third axes, base frame."""
        if self == EVEN or len(cloud) == 0:
            return cloud
        turned = se3.rotation_from_quaternion(cloud.quats_wxyz.astype(np.float64))
        lit = cloud.colors * self.brightness(turned[:, :, 2])[:, None]
        return replace(cloud, colors=as_float32(lit))

    def to_record(self) -> dict[str, Any]:
        """What ``scene.json`` says."""
        return {"brightness_sh2": [round(value, 5) for value in self.coefficients]}


EVEN = Lighting()
"""The same from all sides."""


def read_lighting(record: Mapping[str, Any]) -> Lighting:
    """Light on the arm as ``scene.json`` has it; even in older scenes."""
    found = record.get("robot", {}).get("lighting")
    return EVEN if found is None else Lighting(coefficients=tuple(found["brightness_sh2"]))


@dataclass(frozen=True, kw_only=True)
class Patches:
    """Pieces of surface, each seen in some postures; one row for each time it was seen."""

    ids: Int[np.ndarray, " num_seen"]
    """Which piece."""
    colors: Float[np.ndarray, "num_seen 3"]
    normals: Float[np.ndarray, "num_seen 3"]
    """Where it faced, base frame."""
    weights: Float[np.ndarray, " num_seen"]


def fit_lighting(seen: Sequence[Patches]) -> Lighting:
    """The light under which each piece of surface has one paint, as well as that goes.

    Alternating least squares: paint of each piece, light of all. Pieces seen facing one way only
    say nothing of light.
    """
    if not seen or not sum(len(item.ids) for item in seen):
        return EVEN
    names = ("ids", "colors", "normals", "weights")
    ids, colors, normals, weights = (
        np.concatenate([getattr(item, name) for item in seen]) for name in names
    )
    count = int(ids.max()) + 1
    basis, even = _basis(normals), np.array(EVEN.coefficients)
    found = even.copy()
    for _ in range(ROUNDS):
        light = basis @ found
        power = np.maximum(np.bincount(ids, weights * light**2, count), 1e-9)
        paint = np.stack(
            [np.bincount(ids, weights * light * colors[:, k], count) / power for k in range(3)],
            axis=1,
        )[ids]
        strength = weights * np.square(paint).sum(axis=1)
        ridge = RIDGE * strength.sum() * np.eye(NUM_COEFFICIENTS)
        left = (basis * strength[:, None]).T @ basis + ridge
        right = basis.T @ (weights * (paint * colors).sum(axis=1)) + ridge @ even
        found = np.linalg.solve(left, right)
        found /= max(float(np.average(basis @ found, weights=weights)), 1e-6)
    return Lighting(coefficients=tuple(found.tolist()))


def _basis(normals: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, "num_points 9"]:
    x, y, z = np.ascontiguousarray(normals.T)
    second = (x * y, y * z, 3 * z**2 - 1, x * z, x**2 - y**2)
    return np.stack([np.ones_like(x), x, y, z, *second], axis=1)
