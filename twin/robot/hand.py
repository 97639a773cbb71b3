"""A described arm up to its hand: kinematics from zero joints, and the hulls that push things.

For arms that are known from a URDF alone: joints may turn without end, and all fingers are at one
angle, which nothing drives.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from twin.robot.collision import collision_geometry, convex_hull, corners_of
from twin.robot.model import RobotDescriptionError, built, with_absolute_meshes

_PACKAGE = "package://"


class Hand:
    """One arm with what hangs on its hand link."""

    def __init__(self, urdf: Path, joints: tuple[str, ...], hand_link: str) -> None:
        """Read a description; meshes are looked for beside it."""
        if not urdf.is_file():
            raise RobotDescriptionError(
                f"is not at {urdf}", "Import the data set again, with its robot folder."
            )
        text = with_absolute_meshes(urdf.read_text(), partial(_beside, urdf.parent))
        self._model = model = built(text)
        self._data = model.createData()
        known = list(model.names)[1:]
        missing = [name for name in joints if name not in known]
        if missing:
            raise RobotDescriptionError(
                f"lacks the joints {', '.join(missing)}", f"It has: {', '.join(known)}."
            )
        if not model.existFrame(hand_link):
            names = ", ".join(frame.name for frame in model.frames if frame.type == pin.BODY)
            raise RobotDescriptionError(f"lacks {hand_link!r}", f"It has: {names}.")
        self._frame = model.getFrameId(hand_link)
        behind = model.subtrees[model.frames[self._frame].parentJoint]
        self._pieces = [
            (item.parentJoint, item.placement, np.array(convex_hull(corners_of(item)).points()))
            for item in collision_geometry(model, text).geometryObjects
            if item.parentJoint in behind
        ]
        arm = [model.getJointId(name) for name in joints]
        fingers = {joint for joint, _, _ in self._pieces}.difference(arm)
        self._arm, self._fingers = ([model.joints[k].idx_v for k in ids] for ids in (arm, fingers))

    def _turn(self, joints: list[int], angles_rad: Any) -> Float[np.ndarray, " num_values"]:
        """Place all links with some joints at these angles, the others at zero."""
        turned = np.zeros(self._model.nv)
        turned[joints] = angles_rad
        q = pin.integrate(self._model, pin.neutral(self._model), turned)
        pin.framesForwardKinematics(self._model, self._data, q)
        return np.asarray(q)

    def T_base_hand(self, joints_rad: Float[np.ndarray, " num_joints"]) -> Float[np.ndarray, "4 4"]:
        """Forward kinematics of the hand link."""
        self._turn(self._arm, joints_rad)
        return np.array(self._data.oMf[self._frame].homogeneous)

    def gravity_nm(
        self, joints_rad: Float[np.ndarray, " num_joints"]
    ) -> Float[np.ndarray, " num_joints"]:
        """Torque with which each joint holds the arm."""
        q = self._turn(self._arm, joints_rad)
        return np.array(pin.computeGeneralizedGravity(self._model, self._data, q))[self._arm]

    def hulls_m(self, finger_rad: float = 0.0) -> list[Float[np.ndarray, "num_points 3"]]:
        """Convex pieces of the hand link and of all links behind it: corners in its frame [m]."""
        self._turn(self._fingers, finger_rad)
        T_hand_base = self._data.oMf[self._frame].inverse()
        hulls = []
        for joint, placement, corners in self._pieces:
            T = (T_hand_base * self._data.oMi[joint] * placement).homogeneous
            hulls.append(corners @ T[:3, :3].T + T[:3, 3])
        return hulls


def _beside(folder: Path, name: str) -> Path:
    local = name.removeprefix(_PACKAGE).partition("/")[2] if _PACKAGE in name else name
    path = folder / local
    if not path.is_file():
        raise RobotDescriptionError(
            f"names the mesh {name!r}, which is not at {path}",
            "Put it there, or import the data set again with its robot folder.",
        )
    return path
