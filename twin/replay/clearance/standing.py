"""What never moves: the table, the panels of containers, the robot's own foot."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import coal
import numpy as np
from jaxtyping import Float

from bridge.geometry.box import box_corners
from twin.replay.clearance.bodies import TABLE, Solid, half_space_solid, solid_of
from twin.replay.clearance.unnamed import Foot
from twin.robot.collision import RobotHulls

Panel = tuple[str, int, tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "3"]]]
"""A container, which of its boxes it is, and that box: ``T_base_panel`` and extents [m]."""

_STILL_M = 1e-9
_SAMPLES = 4


@dataclass(frozen=True, kw_only=True)
class Standing:
    """A panel of a container, or the table."""

    body: str
    piece: int
    """Which of the body's it is."""
    solid: Solid
    T: Float[np.ndarray, "4 4"]
    """``T_base_solid``."""


def standing_bodies(
    panels: Sequence[Panel],
    table_height_m: float,
) -> list[Standing]:
    """The table and the panels, each in its own frame."""
    T_base_table = np.eye(4)
    T_base_table[2, 3] = table_height_m
    found = [Standing(body=TABLE, piece=0, solid=half_space_solid(TABLE), T=T_base_table)]
    for name, piece, (T, extents) in panels:
        solid = solid_of(name, coal.Box(*extents), box_corners(extents))
        found.append(Standing(body=name, piece=piece, solid=solid, T=T))
    return found


@lru_cache(maxsize=4)
def standing_links(hulls: RobotHulls) -> tuple[frozenset[str], Foot | None]:
    """Links whose height no motion changes: the base, and a shoulder that turns about vertical.

    The robot stands on the table with them, so their distance to it says nothing of a plan. With
    them the cylinder about the base's z axis that holds them.
    """
    rng = np.random.default_rng(0)
    corners = []
    for _ in range(_SAMPLES):
        hulls.place(rng.uniform(-1.0, 1.0, len(hulls.robot.arm_ids)), 0.0)
        corners.append(
            [
                hull.points_m @ R.T + t
                for hull, R, t in zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True)
            ]
        )
    lowest = np.array([[points[:, 2].min() for points in posture] for posture in corners])
    still = np.flatnonzero(np.ptp(lowest, axis=0) < _STILL_M)
    if not len(still):
        return frozenset(), None
    held = np.concatenate([posture[index] for posture in corners for index in still])
    foot = Foot(
        radius_m=float(np.hypot(held[:, 0], held[:, 1]).max()), top_m=float(held[:, 2].max())
    )
    return frozenset(hulls.hulls[index].link for index in still), foot
