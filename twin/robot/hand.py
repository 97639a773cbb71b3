"""A described arm up to its hand: kinematics from zero joints, and the hulls that push things.

For arms that are known from a URDF alone: joints may turn without end, and all fingers are at one
angle, which nothing drives.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from twin.robot.collision import collision_geometry, convex_hull, corners_of
from twin.robot.model import RobotDescriptionError, built, parse_description

_PACKAGE = "package://"
_WHOLE_TURN_RAD = "6.283185307179586"


class Hand:
    """One arm with what hangs on its hand link."""

    def __init__(self, urdf: Path, joints: tuple[str, ...], hand_link: str) -> None:
        """Read a description; meshes are looked for beside it."""
        if not urdf.is_file():
            raise RobotDescriptionError(
                f"is not at {urdf}", "Import the data set again, with its robot folder."
            )
        root = parse_description(urdf.read_text())
        _with_local_meshes(root, urdf.parent)
        text = ET.tostring(root, encoding="unicode")
        self._model = built(text)
        geometry = collision_geometry(self._model, text)
        self._data = self._model.createData()
        known = list(self._model.names)[1:]
        missing = [name for name in joints if name not in known]
        if missing:
            raise RobotDescriptionError(
                f"lacks the joints {', '.join(missing)}", f"It has: {', '.join(known)}."
            )
        if not self._model.existFrame(hand_link):
            names = ", ".join(link.get("name", "") for link in root.findall("link"))
            raise RobotDescriptionError(f"lacks {hand_link!r}", f"It has: {names}.")
        arms = [self._model.joints[self._model.getJointId(name)] for name in joints]
        self._ids, self._velocity_ids = [j.idx_q for j in arms], [j.idx_v for j in arms]
        self._frame = self._model.getFrameId(hand_link)
        behind = self._model.subtrees[self._model.frames[self._frame].parentJoint]
        self._pieces = [
            (item.parentJoint, item.placement, np.array(convex_hull(corners_of(item)).points()))
            for item in geometry.geometryObjects
            if item.parentJoint in behind
        ]
        arm = {self._model.getJointId(name) for name in joints}
        self._finger_ids = [
            self._model.joints[index].idx_q
            for index in sorted({joint for joint, _, _ in self._pieces} - arm)
        ]

    def T_base_hand(self, joints_rad: Float[np.ndarray, " num_joints"]) -> Float[np.ndarray, "4 4"]:
        """Forward kinematics of the hand link."""
        q = pin.neutral(self._model)
        q[self._ids] = joints_rad
        pin.framesForwardKinematics(self._model, self._data, q)
        return np.array(self._data.oMf[self._frame].homogeneous)

    def gravity_nm(
        self, joints_rad: Float[np.ndarray, " num_joints"]
    ) -> Float[np.ndarray, " num_joints"]:
        """Torque with which each joint holds the arm."""
        q = pin.neutral(self._model)
        q[self._ids] = joints_rad
        torque = pin.computeGeneralizedGravity(self._model, self._data, q)
        return np.array(torque)[self._velocity_ids]

    def hulls_m(self, finger_rad: float = 0.0) -> list[Float[np.ndarray, "num_points 3"]]:
        """Convex pieces of the hand link and of all links behind it: corners in its frame [m]."""
        q = pin.neutral(self._model)
        q[self._finger_ids] = finger_rad
        pin.framesForwardKinematics(self._model, self._data, q)
        T_hand_base = self._data.oMf[self._frame].inverse()
        hulls = []
        for joint, placement, corners in self._pieces:
            T = (T_hand_base * self._data.oMi[joint] * placement).homogeneous
            hulls.append(corners @ T[:3, :3].T + T[:3, 3])
        return hulls


def _with_local_meshes(root: ET.Element, folder: Path) -> None:
    for joint in root.findall("joint"):  # one number for each joint
        limit = joint.find("limit")
        if joint.get("type") == "continuous" and limit is not None:
            joint.set("type", "revolute")
            limit.set("lower", f"-{_WHOLE_TURN_RAD}")
            limit.set("upper", _WHOLE_TURN_RAD)
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for mesh in link.iter("mesh"):
            name = mesh.get("filename", "")
            local = name.removeprefix(_PACKAGE).partition("/")[2] if _PACKAGE in name else name
            path = folder / local
            if not path.is_file():
                raise RobotDescriptionError(
                    f"names the mesh {name!r}, which is not at {path}",
                    "Put it there, or import the data set again with its robot folder.",
                )
            mesh.set("filename", str(path))
