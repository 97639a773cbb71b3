"""What soft bodies do to the robot: forces on its links, and fingers that yield.

Called in every physics step, so in plain numbers: arrays of three cost more than the sums.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from twin.physics.arm import Arm, LinkPose

Three = tuple[float, float, float]


class Reaction:
    """Carries what the soft bodies did in one step into the next step of the rigid world."""

    def __init__(self, arm: Arm, link_of: Mapping[int, str], period_s: float) -> None:
        """Remember who is who.

        Args:
            arm: The robot.
            link_of: Links by the numbers of their pieces.
            period_s: Length of a step.
        """
        self._arm, self._link_of, self._period_s = arm, link_of, period_s
        self._yields = False

    def apply(
        self,
        pushed: Sequence[int],
        pushes: Float[np.ndarray, "num_pieces 15"],
        poses: Mapping[str, LinkPose],
    ) -> None:
        """Push the arm and slow the fingers.

        Args:
            pushed: Pieces that anything pushed.
            pushes: Momentum and its moment about the frame, per piece, of the last step.
            poses: Where the links are.
        """
        apart = 0.0
        wrenches: dict[str | None, list[float]] = {}
        for piece in pushed:
            link = self._link_of.get(piece)
            if link is None:
                continue
            p, q = poses[link]
            row = (pushes[piece, :6] / self._period_s).tolist()
            force, moment = tuple(row[:3]), tuple(row[3:])
            finger = self._arm.links[link] in self._arm.finger_links
            if finger:
                apart += _dot(force, _rotated(q, self._arm.opening_axis(link)))
            # The fingers' own forces meet in what carries them; their drive feels the rest.
            wrench = wrenches.setdefault(None if finger else link, [0.0] * 6)
            for k, value in enumerate((*force, *_sum(moment, _cross(p, force)))):
                wrench[k] += value
        for link, wrench in wrenches.items():
            force, moment = tuple(wrench[:3]), tuple(wrench[3:])
            size = _dot(force, force)
            # Where the force alone has the moment, but for a twist about itself.
            point = tuple(value / size for value in _cross(force, moment)) if size else force
            self._arm.push(link, force, point)
        if wrenches or self._yields:
            self._arm.yield_fingers(apart / len(self._arm.finger_links))
        self._yields = bool(wrenches)


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: tuple[float, ...], b: tuple[float, ...]) -> Three:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _sum(a: tuple[float, ...], b: tuple[float, ...]) -> Three:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _rotated(q_xyzw: tuple[float, ...], v: tuple[float, ...]) -> Three:
    """Turn a vector: v + 2 w (u x v) + 2 u x (u x v) for the quaternion (u, w)."""
    u, w = q_xyzw[:3], q_xyzw[3]
    once = _cross(u, v)
    twice = _cross(u, once)
    return (
        v[0] + 2 * (w * once[0] + twice[0]),
        v[1] + 2 * (w * once[1] + twice[1]),
        v[2] + 2 * (w * once[2] + twice[2]),
    )
