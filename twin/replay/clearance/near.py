"""Pairs of convex bodies with a lower bound of their distance, nearest first.

A body is at least as far away as the box and the sphere that hold it. Where boxes are turned
against each other this is nearly exact, so most pairs need no distance (tests/parity compares).
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from twin.replay._clearance import Bounds
from twin.replay.clearance.bodies import Solid, solid_of
from twin.robot.collision import RobotHulls

_SLACK_M = 1e-6
"""Measured distances are exact to this much: bounds stay below them."""


class NearPairs:
    """Some pairs of bodies; where each body is, is written into ``R`` and ``t``."""

    def __init__(self, solids: Sequence[Solid], pairs: Sequence[tuple[int, int]]) -> None:
        """Lay boxes and spheres out.

        Args:
            solids: The bodies.
            pairs: Two of them each.
        """
        self.R: Float[np.ndarray, "num_bodies 3 3"] = np.tile(np.eye(3), (len(solids), 1, 1))
        """Rotations ``R_base_body``."""
        self.t: Float[np.ndarray, "num_bodies 3"] = np.zeros((len(solids), 3))
        """Positions of the bodies' frames [m]."""
        self._bounds = np.empty(len(pairs))
        self._order = np.empty(len(pairs), dtype=np.int32)
        self._native = Bounds(
            np.array([solid.centre for solid in solids], dtype=np.float64).reshape(-1, 3),
            np.array([solid.half_m for solid in solids], dtype=np.float64).reshape(-1, 3),
            np.array([solid.radius_m for solid in solids], dtype=np.float64),
            np.array(pairs, dtype=np.int32).reshape(-1, 2),
        )

    def nearest_first(self) -> Iterator[tuple[float, int]]:
        """Yield a bound that the signed distance is not below [m], and the number of the pair."""
        self._native.nearest_first(self.R, self.t, self._bounds, self._order)
        return zip((self._bounds - _SLACK_M).tolist(), self._order.tolist(), strict=True)


class OwnLinks:
    """The robot's links against each other."""

    def __init__(self, hulls: RobotHulls) -> None:
        """Choose the pairs that must stay apart.

        Args:
            hulls: The robot.
        """
        self._hulls = hulls
        solids = [solid_of(hull.link, hull.shape, hull.points_m) for hull in hulls.hulls]
        self._near = NearPairs(solids, hulls.pairs)

    def touch(self) -> bool:
        """Whether any touch where the hulls have been placed."""
        self._near.R[:] = self._hulls.rotations
        self._near.t[:] = self._hulls.translations
        for bound_m, index in self._near.nearest_first():
            if bound_m > 0:
                return False
            if self._hulls.pair_distance_m(index) <= 0:
                return True
        return False


@lru_cache(maxsize=4)
def own_links(hulls: RobotHulls) -> OwnLinks:
    """Return the pairs of a robot, made once."""
    return OwnLinks(hulls)
