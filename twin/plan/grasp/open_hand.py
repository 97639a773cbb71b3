"""The open hand on its straight way to a grasp: convex pieces in the tool's frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from twin.plan.problem import Flags, Numbers, Points, Poses, Vector
from twin.robot.collision import hulls_of
from twin.robot.model import RobotModel

_SAME_M = 0.001
"""A hand whose pieces differ by less from themselves turned half about the approach is the same."""


@dataclass(frozen=True, kw_only=True)
class SweptPiece:
    """One convex piece of the hand and all places it passes on the approach, tool frame."""

    finger: bool
    """Whether it closes on objects; else it carries those that do."""
    corners_m: Points
    """Of the piece at the grasp, not swept."""
    normals: Points
    """Outward, of the swept piece."""
    offsets_m: Numbers
    low_m: Vector
    high_m: Vector


@dataclass(frozen=True, kw_only=True)
class OpenHand:
    """A hand at one opening, swept along its approach."""

    pieces: tuple[SweptPiece, ...]
    open_m: float
    tip_m: float
    """How far the fingers reach beyond the tool centre point."""
    depth_m: float
    """From the tool centre point back to what carries the fingers."""
    pad_half_m: float
    """Half the breadth of the narrowest finger piece at the tips, along the tool's x axis."""
    symmetric: bool
    """Whether it is the same after half a turn about the approach."""

    def hits(
        self, points_m: Float[np.ndarray, "3 num_poses num_points"], margin_m: float
    ) -> dict[str, Flags]:
        """Which hands have a point within reach of the fingers, and of what carries them.

        Args:
            points_m: In the tool frame of each hand; x, y and z one after the other, which is
                four times as fast to go through.
            margin_m: Points nearer than this to a swept piece count; at edges and corners
                up to 1.7 times as far.
        """
        num = points_m.shape[1]
        found = {"fingers": np.zeros(num, dtype=bool), "palm": np.zeros(num, dtype=bool)}
        for piece in self.pieces:
            low, high = piece.low_m - margin_m, piece.high_m + margin_m
            near = points_m[2] > low[2]
            near &= points_m[2] < high[2]
            for axis in (0, 1):
                near &= points_m[axis] > low[axis]
                near &= points_m[axis] < high[axis]
            poses, ids = np.nonzero(near)
            if not len(poses):
                continue
            heights = points_m[:, poses, ids].T @ piece.normals.T + piece.offsets_m
            inside = heights.max(axis=1) < margin_m
            found["fingers" if piece.finger else "palm"][poses[inside]] = True
        return found

    def lowest_m(self, Ts_base_tcp: Poses) -> Numbers:
        """Height of each hand's lowest point at the grasp, base frame."""
        corners = np.concatenate([piece.corners_m for piece in self.pieces])
        heights = Ts_base_tcp[:, 2, :3] @ corners.T + Ts_base_tcp[:, 2, 3, None]
        return np.asarray(heights.min(axis=1))


def has_fingers(robot: RobotModel) -> bool:
    """Whether anything of a robot closes."""
    gripper = robot.record.gripper
    return bool(gripper.fingers and gripper.finger_links and gripper.max_width_m > 0)


@lru_cache(maxsize=64)
def open_hand(robot: RobotModel, open_m: float, pregrasp_m: float) -> OpenHand:
    """Lay out a robot's hand at one opening."""
    hulls, gripper = hulls_of(robot), robot.record.gripper
    hulls.place(robot.home_rad, open_m)
    placed = [
        (hull.link, hull.points_m @ R.T + t)
        for hull, R, t in zip(hulls.hulls, hulls.rotations, hulls.translations, strict=True)
        if hull.link in gripper.links
    ]
    T_tcp_base = se3.invert(robot.T_base_link(robot.record.tool_frame, robot.home_rad, open_m))
    fingers = set(gripper.finger_links)
    pieces = [
        _swept(link in fingers, se3.apply(T_tcp_base, points), pregrasp_m)
        for link, points in placed
    ]
    closing = [piece for piece in pieces if piece.finger]
    palm = [piece for piece in pieces if not piece.finger]
    tips = [piece for piece in closing if piece.corners_m[:, 2].max() > 0] or closing
    return OpenHand(
        pieces=tuple(pieces),
        open_m=open_m,
        tip_m=max(float(piece.corners_m[:, 2].max()) for piece in closing),
        depth_m=-max((float(piece.corners_m[:, 2].max()) for piece in palm), default=-np.inf),
        pad_half_m=min(float(np.abs(piece.corners_m[:, 0]).max()) for piece in tips),
        symmetric=_is_symmetric(pieces),
    )


def _swept(finger: bool, corners_m: Points, pregrasp_m: float) -> SweptPiece:
    corners = corners_m[ConvexHull(corners_m).vertices]
    swept = np.concatenate([corners, corners - [0.0, 0.0, pregrasp_m]])
    equations = np.unique(ConvexHull(swept).equations.round(9), axis=0)
    return SweptPiece(
        finger=finger,
        corners_m=corners,
        normals=equations[:, :3],
        offsets_m=equations[:, 3],
        low_m=swept.min(axis=0),
        high_m=swept.max(axis=0),
    )


def _is_symmetric(pieces: Sequence[SweptPiece]) -> bool:
    """Compare the boxes around the pieces with those of the hand turned half."""

    def boxes(sign: float) -> Float[np.ndarray, "num_pieces 6"]:
        turn = np.array([sign, sign, 1.0])
        table = np.array([np.sort([p.low_m * turn, p.high_m * turn], 0).ravel() for p in pieces])
        return table[np.lexsort(np.rint(table / _SAME_M).T)]

    return bool(np.abs(boxes(1.0) - boxes(-1.0)).max() < _SAME_M)
