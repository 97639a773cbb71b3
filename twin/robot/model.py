"""The robot as pinocchio sees it: its URDF, joint limits, forward kinematics of arm and gripper.

One arm of revolute joints and, where the description has them, two prismatic fingers that open by
half of the gripper width each. A model keeps scratch memory: use it from one thread at a time.
"""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from bridge.episode.topics import ROBOT_DESCRIPTION
from bridge.robots.default import ARM_JOINTS, BASE_FRAME, FINGER_JOINTS, ROBOT, TCP_FRAME
from bridge.robots.robot import resolve_mesh
from twin.errors import TwinError

_MIMIC_DEFAULTS = (("multiplier", "1"), ("offset", "0"))


class RobotDescriptionError(TwinError):
    """A URDF text cannot be used."""

    def __init__(self, *, found: str, hint: str) -> None:
        """Remember what was found."""
        self.found = found
        super().__init__(f"the robot description {found}. {hint}")


@dataclass(frozen=True, kw_only=True)
class Mimic:
    """A joint that goes where another one goes: multiplier * leader + offset."""

    joint: str
    leader: str
    multiplier: float
    offset: float


def mimicked(urdf: str) -> list[Mimic]:
    """Read the joints that follow another joint, which pinocchio takes for free ones.

    Raises:
        RobotDescriptionError: When one follows a joint that is not there, or follows another one
            itself, or by a number that is none.
    """
    root = parse_description(urdf)
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    followers = {
        name: element
        for name, joint in joints.items()
        if (element := joint.find("mimic")) is not None
    }
    return [
        _mimic(name, element, set(joints) - set(followers)) for name, element in followers.items()
    ]


def _mimic(name: str, element: ET.Element, leaders: set[str]) -> Mimic:
    leader = element.get("joint", "")
    if leader not in leaders:
        raise RobotDescriptionError(
            found=f"lets the joint {name!r} mimic {leader!r}, which is not there or mimics another",
            hint="Let it mimic a joint that moves by itself.",
        )
    try:
        numbers = [float(element.get(key, default)) for key, default in _MIMIC_DEFAULTS]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise RobotDescriptionError(
            found=f"lets the joint {name!r} mimic {leader!r} by something that is not a number",
            hint="Give multiplier and offset as numbers.",
        )
    multiplier, offset = numbers
    return Mimic(joint=name, leader=leader, multiplier=multiplier, offset=offset)


def with_absolute_meshes(urdf: str, *, keep_visuals: bool = False) -> str:
    """Replace ``package://`` URIs by paths; visuals are dropped unless they are wanted.

    Args:
        urdf: Text of the description.
        keep_visuals: Leave what is drawn in; collision elements always stay.

    Raises:
        RobotDescriptionError: When the text is not a URDF.
        UsageError: When a mesh is not there, or is in an unknown package.
    """
    root = parse_description(urdf)
    for link in root.findall("link"):
        if not keep_visuals:
            for visual in link.findall("visual"):
                link.remove(visual)
        for mesh in link.iter("mesh"):
            mesh.set("filename", str(resolve_mesh(mesh.get("filename", ""))))
    return ET.tostring(root, encoding="unicode")


def parse_description(urdf: str) -> ET.Element:
    """Parse a URDF text. Raises ``RobotDescriptionError`` when it is none or parts lack names."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise RobotDescriptionError(
            found=f"is not XML ({error})",
            hint=f"Record the robot's URDF on {ROBOT_DESCRIPTION}, or attach it as robot.urdf.",
        ) from error
    if root.tag != "robot":
        raise RobotDescriptionError(
            found=f"has the root element <{root.tag}>, not <robot>",
            hint="Expand xacro files before publishing them.",
        )
    _check_names(root)
    return root


def _check_names(root: ET.Element) -> None:
    """Readers of URDF that meet a part without a name may take the process with them."""
    for tag in ("link", "joint"):
        names = [element.get("name", "").strip() for element in root.findall(tag)]
        if "" in names:
            raise RobotDescriptionError(
                found=f"has a {tag} without a name", hint="Name every link and joint."
            )
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise RobotDescriptionError(
                found=f"has more than one {tag} named {', '.join(twice)}",
                hint="Give each a name of its own.",
            )


_SAME_FRAME = 1e-6


class RobotModel:
    """Kinematics of one robot, joints in the order of ``ARM_JOINTS``."""

    def __init__(self, urdf: str) -> None:
        """Build from a URDF text; use ``load_robot``, which remembers.

        Raises:
            RobotDescriptionError: When joints or the frame ``tcp`` are missing, joints are of
                another kind than is needed, or the base link is not where the root is.
        """
        self.urdf = with_absolute_meshes(urdf)
        mimics = mimicked(urdf)
        try:
            self.model = pin.buildModelFromXML(self.urdf)
        except (ValueError, RuntimeError) as error:
            raise RobotDescriptionError(
                found=f"is refused by pinocchio ({str(error)[:200]})", hint="Check it."
            ) from error
        self.name = str(self.model.name)
        self._check_names()
        self._check_joints()
        self._check_base()
        self.data = self.model.createData()
        self._neutral: Float[np.ndarray, " num_values"] = pin.neutral(self.model)
        self.arm_ids = np.array([self._q_id(name) for name in ARM_JOINTS])
        self.arm_velocity_ids = np.array(
            [int(self.model.joints[self.model.getJointId(name)].idx_v) for name in ARM_JOINTS]
        )
        self._fingers = [
            (self._q_id(finger.joint), finger)
            for finger in ROBOT.gripper.fingers
            if self.model.existJointName(finger.joint)
        ]
        followers = [m for m in mimics if self.model.existJointName(m.joint)]
        self._check_followers(followers)
        self._follower_ids = np.array([self._q_id(m.joint) for m in followers], dtype=np.int64)
        self._leader_ids = np.array([self._q_id(m.leader) for m in followers], dtype=np.int64)
        self._ratios = np.array([m.multiplier for m in followers])
        self._shifts = np.array([m.offset for m in followers])
        self.tcp_id = int(self.model.getFrameId(TCP_FRAME))
        self.lower_rad: Float[np.ndarray, " num_joints"] = self._arm(self.model.lowerPositionLimit)
        self.upper_rad: Float[np.ndarray, " num_joints"] = self._arm(self.model.upperPositionLimit)
        self.velocity_limit_rad_s: Float[np.ndarray, " num_joints"] = self._arm(
            self.model.velocityLimit
        )
        self._check_limits()

    def _check_names(self) -> None:
        missing = [name for name in ARM_JOINTS if not self.model.existJointName(name)]
        if missing:
            raise RobotDescriptionError(
                found=f"lacks the joints {', '.join(missing)}",
                hint=f"It has: {', '.join(list(self.model.names)[1:])}.",
            )
        if not self.model.existFrame(TCP_FRAME):
            raise RobotDescriptionError(
                found=f"lacks the frame {TCP_FRAME!r}",
                hint="Add a link of that name where plans put the tool centre point.",
            )

    def _check_joints(self) -> None:
        for name in ARM_JOINTS:
            if self._joint(name).nq != 1:
                raise RobotDescriptionError(
                    found=f"has the joint {name!r}, which turns without end",
                    hint="Make it revolute and give it limits.",
                )
            if self._slides(name):
                raise RobotDescriptionError(
                    found=f"has the joint {name!r}, which slides",
                    hint="An arm of six joints that turn is needed.",
                )
        for name in FINGER_JOINTS:
            if self.model.existJointName(name) and not self._slides(name):
                raise RobotDescriptionError(
                    found=f"has the finger joint {name!r}, which does not slide",
                    hint="Two prismatic fingers are needed, each open by half of the width.",
                )

    def _check_limits(self) -> None:
        """Nothing is ever beyond a limit that is not a number."""
        rows = zip(
            ARM_JOINTS, self.lower_rad, self.upper_rad, self.velocity_limit_rad_s, strict=True
        )
        for name, low, high, speed in rows:
            if not (low < high and speed >= 0):
                raise RobotDescriptionError(
                    found=f"limits the joint {name!r} to {low:.3f} to {high:.3f} rad and "
                    f"{speed:.3f} rad/s",
                    hint="Give lower, upper and velocity as numbers, lower below upper.",
                )

    def _check_followers(self, followers: list[Mimic]) -> None:
        for item in followers:
            for name in (item.joint, item.leader):
                if not self.model.existJointName(name) or self._joint(name).nq != 1:
                    raise RobotDescriptionError(
                        found=f"lets the joint {item.joint!r} mimic {item.leader!r}, and {name!r} "
                        "is fixed or turns without end",
                        hint="Make both revolute or prismatic, with limits.",
                    )

    def _check_base(self) -> None:
        """Plans and objects are given in the base link, kinematics in the root."""
        if not self.model.existFrame(BASE_FRAME):
            return
        frame = self.model.frames[self.model.getFrameId(BASE_FRAME)]
        T_root_base = np.array(frame.placement.homogeneous)
        if frame.parentJoint != 0 or np.abs(T_root_base - np.eye(4)).max() > _SAME_FRAME:
            x, y, z = T_root_base[:3, 3]
            raise RobotDescriptionError(
                found=f"puts {BASE_FRAME!r} elsewhere than its root {self.model.frames[1].name!r}: "
                f"at ({x:.3f}, {y:.3f}, {z:.3f}) m, or turned",
                hint=f"Plans and objects are given in {BASE_FRAME!r}: let it be the root.",
            )

    def _joint(self, name: str) -> Any:
        return self.model.joints[self.model.getJointId(name)]

    def _slides(self, name: str) -> bool:
        joint = self._joint(name)
        return bool(joint.nq == 1 and joint.shortname().startswith("JointModelP"))

    def _q_id(self, name: str) -> int:
        return int(self.model.joints[self.model.getJointId(name)].idx_q)

    def _arm(self, values: Float[np.ndarray, " num_values"]) -> Float[np.ndarray, " num_joints"]:
        picked: Float[np.ndarray, " num_joints"] = np.asarray(values)[self.arm_ids]
        return picked

    def configuration(
        self, joints_rad: Float[np.ndarray, " num_joints"], width_m: float = 0.0
    ) -> Float[np.ndarray, " num_values"]:
        """Put arm joints and what the gripper width makes of its fingers into pinocchio's order.

        Args:
            joints_rad: Of the arm, from base to hand.
            width_m: Distance between the finger pads.
        """
        q = self._neutral.copy()
        q[self.arm_ids] = joints_rad
        for index, finger in self._fingers:
            q[index] = finger.value(width_m)
        if len(self._follower_ids):
            q[self._follower_ids] = self._ratios * q[self._leader_ids] + self._shifts
        return q

    def T_base_tcp(self, joints_rad: Float[np.ndarray, " num_joints"]) -> Float[np.ndarray, "4 4"]:
        """Forward kinematics of the tool centre point."""
        pin.forwardKinematics(self.model, self.data, self.configuration(joints_rad))
        T = pin.updateFramePlacement(self.model, self.data, self.tcp_id)
        return np.array(T.homogeneous)

    def Ts_base_tcp(
        self, joints_rad: Float[np.ndarray, "num_steps num_joints"]
    ) -> Float[np.ndarray, "num_steps 4 4"]:
        """Forward kinematics along a joint path."""
        return np.stack([self.T_base_tcp(row) for row in joints_rad])

    def T_base_link(
        self, link: str, joints_rad: Float[np.ndarray, " num_joints"], width_m: float = 0.0
    ) -> Float[np.ndarray, "4 4"]:
        """Pose of any link or frame.

        Args:
            link: Name in the description.
            joints_rad: Of the arm, from base to hand.
            width_m: Distance between the finger pads.

        Raises:
            RobotDescriptionError: Listing the frames that exist.
        """
        if not self.model.existFrame(link):
            names = ", ".join(frame.name for frame in self.model.frames)
            raise RobotDescriptionError(found=f"lacks {link!r}", hint=f"It has: {names}.")
        pin.forwardKinematics(self.model, self.data, self.configuration(joints_rad, width_m))
        T = pin.updateFramePlacement(self.model, self.data, self.model.getFrameId(link))
        return np.array(T.homogeneous)


@lru_cache(maxsize=4)
def load_robot(urdf: str) -> RobotModel:
    """Return the model of a URDF text, built once per text and process."""
    return RobotModel(urdf)
