"""Tie an object to the tool instead of holding it by friction: ``--grasp attach``, not the default.

For robots or grippers whose friction nobody knows. What is tied cannot slip, so a verdict made this
way says nothing about the grasp; the engine's name carries the word wherever it is shown.
"""

import numpy as np

from bridge.geometry import se3
from bridge.task.robot import TCP_FRAME
from twin.physics.engine import pybullet
from twin.physics.world import World

PRESS_M = 0.001
"""Fingers that are told to go this much farther than they are press on something."""
OPEN_M = 0.002
"""An object is let go when the fingers are told to be this much wider than when it was tied."""


class Attachment:
    """Holds at most one rigid object by a fixed joint, from the touch to the command to open."""

    def __init__(self, world: World) -> None:
        """Start with empty fingers."""
        self._world = world
        self._constraint: int | None = None
        self._width_m = 0.0

    def update(self, command_m: float) -> None:
        """Tie what the fingers press on, or let go. Call once per step.

        Args:
            command_m: The distance the fingers are told to have.
        """
        if self._constraint is not None:
            if command_m > self._width_m + OPEN_M:
                pybullet.removeConstraint(self._constraint, physicsClientId=self._world.client)
                self._constraint = None
            return
        width_m = self._world.width_m()
        if command_m > width_m - PRESS_M:
            return
        for object_id in self._world.free_ids:
            if self._world.finger_touches(object_id):
                self._constraint, self._width_m = self._tie(object_id), width_m
                return

    def _tie(self, object_id: str) -> int:
        T_tcp_base = se3.invert(self._world.T_base_link(TCP_FRAME))
        q, p = se3.split(T_tcp_base @ self._world.T_base_object(object_id))
        w, x, y, z = q.tolist()
        return int(
            pybullet.createConstraint(
                self._world.robot_id,
                self._world.link_id(TCP_FRAME),
                self._world.free_ids[object_id],
                -1,
                pybullet.JOINT_FIXED,
                [0, 0, 0],
                np.asarray(p).tolist(),
                [0, 0, 0],
                [x, y, z, w],
                [0, 0, 0, 1],
                physicsClientId=self._world.client,
            )
        )
