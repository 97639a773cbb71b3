"""The robot as pinocchio sees it: its URDF, joint limits, forward kinematics of arm and gripper.

One serial arm of joints that turn and, where its record has them, fingers that open with the
width. Poses are in the record's base frame, wherever the description's root is. A model keeps
scratch memory: use it from one thread at a time.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from bridge.episode.topics import ROBOT_DESCRIPTION
from bridge.robots.robot import Mimic, Robot, mimics_of, number_of, resolve_mesh, robot_of
from twin.errors import TwinError


class RobotDescriptionError(TwinError):
    """A URDF text cannot be used."""

    def __init__(self, found: str, hint: str) -> None:
        """Say what was found, and what helps."""
        super().__init__(f"the robot description {found}. {hint}")


def mimicked(urdf: str) -> tuple[Mimic, ...]:
    """Read the joints that follow one; RobotDescriptionError: absent, a follower or bad factor."""
    root = parse_description(urdf)
    found = mimics_of(urdf)  # pinocchio takes them for free ones
    leaders = {joint.get("name", "") for joint in root.findall("joint")}
    leaders -= {item.joint for item in found}
    for item in found:
        if item.leader not in leaders:
            raise RobotDescriptionError(
                f"lets the joint {item.joint!r} mimic {item.leader!r}, which is not there or "
                "mimics another",
                "Let it mimic a joint that moves by itself.",
            )
        if not (math.isfinite(item.multiplier) and math.isfinite(item.offset)):
            raise RobotDescriptionError(
                f"lets the joint {item.joint!r} mimic {item.leader!r} by something that is "
                "not a number",
                "Give multiplier and offset as numbers.",
            )
    return found


def with_absolute_meshes(urdf: str, resolve: Callable[[str], Path] = resolve_mesh) -> str:
    """Replace ``package://`` URIs by paths; visuals are dropped."""
    root = parse_description(urdf)
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for mesh in link.iter("mesh"):
            mesh.set("filename", str(resolve(mesh.get("filename", ""))))
    return ET.tostring(root, encoding="unicode")


def parse_description(urdf: str) -> ET.Element:
    """Parse a URDF text. Raises ``RobotDescriptionError`` when it is none or parts lack names."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise RobotDescriptionError(
            f"is not XML ({error})",
            f"Record the robot's URDF on {ROBOT_DESCRIPTION}, or attach it as robot.urdf.",
        ) from error
    if root.tag != "robot":
        raise RobotDescriptionError(
            f"has the root element <{root.tag}>, not <robot>",
            "Expand xacro files before publishing them.",
        )
    _check_names(root)
    return root


def _check_names(root: ET.Element) -> None:
    """Readers of URDF that meet a part without a name may take the process with them."""
    for tag in ("link", "joint"):
        names = [element.get("name", "").strip() for element in root.findall(tag)]
        if "" in names:
            raise RobotDescriptionError(f"has a {tag} without a name", "Name every link and joint.")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise RobotDescriptionError(
                f"has more than one {tag} named {', '.join(twice)}", "Give each a name of its own."
            )


def numbers_in(element: ET.Element, *keys: str) -> list[float]:
    """Read the numbers of attributes; what is none becomes NaN."""
    return [number_of(word) for key in keys for word in element.get(key, "").split()]


def _refusals(root: ET.Element) -> Iterator[str]:
    """Name every joint and link that no engine can take, not the first one only."""
    for joint in root.findall("joint"):
        kind, axis, name = joint.get("type", ""), joint.find("axis"), joint.get("name")
        if kind not in _KINDS:
            yield f"the joint {name!r} of the type {kind!r}"
        elif kind != "fixed" and axis is not None:
            length = float(np.linalg.norm(numbers_in(axis, "xyz")))
            if not length > 0:
                yield f"the joint {name!r} with an axis of length {length:g}"
    for link in root.findall("link"):
        for shape in link.findall("collision/geometry/*"):
            sizes = numbers_in(shape, "size", "radius", "length")
            if not all(size > 0 for size in sizes):
                told = " ".join(f"{size:g}" for size in sizes)
                yield f"the link {link.get('name')!r} with a {shape.tag} of size {told}"


_SAME_FRAME = 1e-6
_TURNS_RAD = 2 * np.pi
"""Limit, to both sides, of a joint that turns without end."""
_ROOT = "gst_root"
"""Link that is put above the root of a description whose base lies elsewhere."""
_KINDS = ("fixed", "revolute", "prismatic", "continuous")


def _with_limits(urdf: str, record: Robot) -> str:
    """Write the record's limits into a description; the arm's endless joints get two turns."""
    root = parse_description(urdf)
    refused = list(_refusals(root))
    if refused:
        raise RobotDescriptionError(
            f"has {'; '.join(refused)}",
            "A serial arm on a fixed base is needed, of joints with one axis each and of "
            "shapes with three extents above 0.",
        )
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    for shape in root.findall("link/collision/geometry/capsule"):  # readers of URDF pass it over
        radius, length = (number_of(shape.get(key, "")) for key in ("radius", "length"))
        shape.tag = "cylinder"  # around it
        shape.set("length", repr(length + 2 * radius))
    for index, name in enumerate(record.joints):
        found = joints.get(name)
        if found is None:
            continue
        limits: dict[str, float] = {}
        if found.get("type") == "continuous":
            found.set("type", "revolute")
            limits |= {"lower": -_TURNS_RAD, "upper": _TURNS_RAD}
        if record.position_rad is not None:
            limits |= dict(zip(("lower", "upper"), record.position_rad[index], strict=True))
        if record.velocity_rad_s is not None:
            limits["velocity"] = record.velocity_rad_s[index]
        if limits:
            element = found.find("limit")
            if element is None:
                element = ET.SubElement(found, "limit", effort="0", velocity="0")
            for key, value in limits.items():
                element.set(key, repr(value))
    return ET.tostring(root, encoding="unicode")


def _rooted(urdf: str, T_base_root: Float[np.ndarray, "4 4"]) -> str:
    """Put a root above a description where its base is, so that every engine counts from there."""
    root = parse_description(urdf)
    children = {child.get("link") for child in root.findall("joint/child")}
    links = (link.get("name", "") for link in root if link.tag == "link")
    old = next(name for name in links if name not in children)
    ET.SubElement(root, "link", name=_ROOT)
    joint = ET.SubElement(root, "joint", name=f"{_ROOT}_joint", type="fixed")
    ET.SubElement(joint, "parent", link=_ROOT)
    ET.SubElement(joint, "child", link=old)
    numbers = [*T_base_root[:3, 3], *pin.rpy.matrixToRpy(T_base_root[:3, :3])]
    texts = [repr(float(value)) for value in numbers]
    ET.SubElement(joint, "origin", xyz=" ".join(texts[:3]), rpy=" ".join(texts[3:]))
    return ET.tostring(root, encoding="unicode")


_UNFELT_KG = 0.01


def _bodies(urdf: str) -> set[str]:
    """Name the links that have a mass or can be seen: those that can run into something."""
    found = set()
    for link in parse_description(urdf).findall("link"):
        mass = link.find("inertial/mass")
        weighs = mass is not None and max(numbers_in(mass, "value"), default=0) > _UNFELT_KG
        if weighs or link.find("visual") is not None:
            found.add(link.get("name", ""))
    return found


_OTHER_ROBOT = "Another robot's file is named by --robot FILE.toml."


def built(urdf: str) -> pin.Model:
    """Build what pinocchio makes of a URDF text."""
    try:
        return pin.buildModelFromXML(urdf)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(
            f"is refused by pinocchio ({str(error)[:200]})", "Check it."
        ) from error


class RobotModel:
    """Kinematics of one robot, joints in the order of its record."""

    def __init__(self, urdf: str) -> None:
        """Build from a URDF text; use ``load_robot``, which remembers.

        Raises:
            RobotDescriptionError: When a joint or frame of the record is missing, the joints are
                no serial arm, or the base moves.
            UsageError: When a mesh is missing.
        """
        self.record: Robot = robot_of(urdf)
        mimics = mimicked(urdf)
        self.bodies = _bodies(urdf)
        self.urdf = _with_limits(with_absolute_meshes(urdf), self.record)
        self.model = built(self.urdf)
        self._check_names()
        T_root_base = self._T_root_base()
        if np.abs(T_root_base - np.eye(4)).max() > _SAME_FRAME:
            self.urdf = _rooted(self.urdf, np.linalg.inv(T_root_base))
            self.model = built(self.urdf)
        self.name = str(self.model.name)
        self._check_joints()
        self.data = self.model.createData()
        self._opened: Float[np.ndarray, " num_values"] = pin.neutral(self.model)
        """With the fingers where they were asked for last, at this width [m]."""
        self._opened_m = math.nan
        self.arm_ids = np.array([self._q_id(name) for name in self.joints])
        self.arm_velocity_ids = np.array([self.effort_id(name) for name in self.joints])
        self._fingers = [
            (self._q_id(finger.joint), finger)
            for finger in self.record.gripper.fingers
            if self.model.existJointName(finger.joint)
        ]
        followers = [m for m in mimics if self.model.existJointName(m.joint)]
        self._check_followers(followers)
        self._check_serial({m.joint for m in followers})
        self.followers: tuple[Mimic, ...] = tuple(followers)
        self._follower_ids = np.array([self._q_id(m.joint) for m in followers], dtype=np.int64)
        self._leader_ids = np.array([self._q_id(m.leader) for m in followers], dtype=np.int64)
        self._ratios = np.array([m.multiplier for m in followers])
        self._shifts = np.array([m.offset for m in followers])
        self.tcp_id = self.frame_id(self.record.tool_frame)
        self.lower_rad: Float[np.ndarray, " num_joints"] = self._arm(self.model.lowerPositionLimit)
        self.upper_rad: Float[np.ndarray, " num_joints"] = self._arm(self.model.upperPositionLimit)
        self.velocity_limit_rad_s: Float[np.ndarray, " num_joints"] = self._arm(
            self.model.velocityLimit
        )
        self._check_limits()
        self.home_rad = self._home()

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the arm's joints, base to flange."""
        return self.record.joints

    def _check_names(self) -> None:
        missing = [name for name in self.joints if not self.model.existJointName(name)]
        if missing:
            raise RobotDescriptionError(
                f"lacks the joints {', '.join(missing)} of {self.record.name}",
                f"It has: {', '.join(list(self.model.names)[1:])}. {_OTHER_ROBOT}",
            )
        if not self.model.existFrame(self.record.tool_frame):
            raise RobotDescriptionError(
                f"lacks the frame {self.record.tool_frame!r}",
                f"Add a link of that name where plans put the tool centre point. {_OTHER_ROBOT}",
            )

    def _check_joints(self) -> None:
        for name in self.joints:
            if self._slides(name):
                raise RobotDescriptionError(
                    f"has the joint {name!r}, which slides",
                    "An arm of five to seven joints that turn is needed.",
                )
        for finger in self.record.gripper.fingers:
            name, wanted = finger.joint, "turn" if finger.turns else "slide"
            if not self.model.existJointName(name):
                continue
            if self._joint(name).nq != 1 or self._slides(name) == finger.turns:
                raise RobotDescriptionError(
                    f"has the finger joint {name!r}, which does not {wanted}",
                    "Say of it in the robot file whether it turns, and give it limits.",
                )

    def _check_serial(self, followers: set[str]) -> None:
        """The arm's joints, and no others, lie one behind the other between base and tool."""
        names = list(self.model.names)
        tool = self.model.frames[self.frame_id(self.record.tool_frame)]
        chain: list[str] = []
        joint = int(tool.parentJoint)
        while joint:
            chain.insert(0, names[joint])
            joint = int(self.model.parents[joint])
        aside = [name for name in self.joints if name not in chain]
        if aside:
            raise RobotDescriptionError(
                f"has {', '.join(aside)} on a branch that does not carry the tool frame "
                f"{self.record.tool_frame!r}",
                f"The tool is moved by {', '.join(chain) or 'no joint'}.",
            )
        known = {*self.joints, *self.record.finger_joints, *followers}
        more = [name for name in names[1:] if name not in known]
        if more or [name for name in chain if name in self.joints] != list(self.joints):
            raise RobotDescriptionError(
                f"moves by {', '.join(more or chain)}, "
                + ("which is neither arm nor finger" if more else "in another order"),
                "List the arm's joints from base to tool as joints, those that never move as "
                "held, the fingers' under gripper.fingers.",
            )

    def _check_limits(self) -> None:
        """Nothing is ever beyond a limit that is not a number."""
        rows = zip(
            self.joints, self.lower_rad, self.upper_rad, self.velocity_limit_rad_s, strict=True
        )
        for name, low, high, speed in rows:
            if not (low < high and speed >= 0):
                raise RobotDescriptionError(
                    f"limits the joint {name!r} to {low:.3f} to {high:.3f} rad and "
                    f"{speed:.3f} rad/s",
                    "Give lower, upper and velocity as numbers, lower below upper.",
                )

    def _check_followers(self, followers: Sequence[Mimic]) -> None:
        for item in followers:
            for name in (item.joint, item.leader):
                if not self.model.existJointName(name) or self._joint(name).nq != 1:
                    raise RobotDescriptionError(
                        f"lets the joint {item.joint!r} mimic {item.leader!r}, and {name!r} "
                        "is fixed or turns without end",
                        "Make both revolute or prismatic, with limits, or list both as held.",
                    )

    def _T_root_base(self) -> Float[np.ndarray, "4 4"]:
        """Where the base is in the description's root, which may be another frame."""
        base = self.record.base_frame
        if not self.model.existFrame(base):
            raise RobotDescriptionError(
                f"lacks the base frame {base!r}",
                f"It has: {', '.join(frame.name for frame in self.model.frames)}.",
            )
        frame = self.model.frames[self.frame_id(base)]
        if frame.parentJoint != 0:
            raise RobotDescriptionError(
                f"moves the base frame {base!r} by {self.model.names[frame.parentJoint]!r}",
                "Name a frame that no joint moves as base_frame.",
            )
        return np.array(frame.placement.homogeneous)

    def _home(self) -> Float[np.ndarray, " num_joints"]:
        """The record's posture, or the middle of the limits."""
        if self.record.home_rad is None:
            return np.asarray((self.lower_rad + self.upper_rad) / 2)
        home = np.array(self.record.home_rad)
        for name, value, low, high in zip(
            self.joints, home, self.lower_rad, self.upper_rad, strict=True
        ):
            if not low <= value <= high:
                raise RobotDescriptionError(
                    f"limits the joint {name!r} to {low:.3f} to {high:.3f} rad, and home_rad "
                    f"puts it at {value:.3f}",
                    "Choose a posture within the limits.",
                )
        return home

    def _joint(self, name: str) -> Any:
        return self.model.joints[self.model.getJointId(name)]

    def _slides(self, name: str) -> bool:
        joint = self._joint(name)
        return bool(joint.nq == 1 and joint.shortname().startswith("JointModelP"))

    def frame_id(self, name: str) -> int:
        """Where pinocchio keeps a link; a joint may have the same name."""
        if self.model.existFrame(name, pin.FrameType.BODY):
            return int(self.model.getFrameId(name, pin.FrameType.BODY))
        return int(self.model.getFrameId(name))

    def effort_id(self, name: str) -> int:
        """Where pinocchio keeps the limit of a joint's torque."""
        return int(self._joint(name).idx_v)

    def _q_id(self, name: str) -> int:
        return int(self._joint(name).idx_q)

    def _arm(self, values: Float[np.ndarray, " num_values"]) -> Float[np.ndarray, " num_joints"]:
        return np.array(values[self.arm_ids])

    def configuration(
        self, joints_rad: Float[np.ndarray, " num_joints"], width_m: float = 0.0
    ) -> Float[np.ndarray, " num_values"]:
        """Put arm joints and what the gripper width makes of its fingers into pinocchio's order."""
        if width_m != self._opened_m:  # along a path it seldom changes
            self._opened_m = width_m
            for index, finger in self._fingers:
                self._opened[index] = finger.value(width_m)
        q = self._opened.copy()
        q[self.arm_ids] = joints_rad
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

    def skeleton_m(
        self, joints_rad: Float[np.ndarray, " num_joints"]
    ) -> Float[np.ndarray, "num_points 3"]:
        """Where base, the arm's joints from base to hand, and tool are: the arm as a line [m]."""
        pin.forwardKinematics(self.model, self.data, self.configuration(joints_rad))
        tool = pin.updateFramePlacement(self.model, self.data, self.tcp_id).translation
        joints = [self.data.oMi[self.model.getJointId(name)].translation for name in self.joints]
        return np.array([np.zeros(3), *joints, tool])

    def T_base_link(
        self, link: str, joints_rad: Float[np.ndarray, " num_joints"], width_m: float = 0.0
    ) -> Float[np.ndarray, "4 4"]:
        """Pose of any link or frame."""
        if not self.model.existFrame(link):
            names = ", ".join(frame.name for frame in self.model.frames)
            raise RobotDescriptionError(f"lacks {link!r}", f"It has: {names}.")
        pin.forwardKinematics(self.model, self.data, self.configuration(joints_rad, width_m))
        T = pin.updateFramePlacement(self.model, self.data, self.frame_id(link))
        return np.array(T.homogeneous)


def check_dynamics(robot: RobotModel) -> None:
    """Refuse an arm whose motors or masses nobody knows: it cannot be simulated."""
    lacking = list(without_dynamics(robot))
    if lacking:
        raise RobotDescriptionError(
            f"gives {'; '.join(lacking)}",
            "Give links <inertial> with a mass and an inertia above 0, and joints "
            "<limit effort=...>, the torque of the motor in Nm.",
        )


def without_dynamics(robot: RobotModel) -> Iterator[str]:
    """Name each joint whose motor, or what it moves, cannot be simulated."""
    model = robot.model
    for name in (*robot.joints, *robot.record.finger_joints, *(m.joint for m in robot.followers)):
        joint = model.getJointId(name)
        inertia = model.inertias[joint]
        moved = [frame.name for frame in model.frames if frame.parentJoint == joint]
        if not inertia.mass > 0 or not np.linalg.eigvalsh(inertia.inertia).min() > 0:
            yield f"no inertia to what {name!r} moves: {', '.join(moved[1:])}"
        if name in robot.joints and not model.effortLimit[robot.effort_id(name)] > 0:
            yield f"the joint {name!r} no effort"


@lru_cache(maxsize=4)
def load_robot(urdf: str) -> RobotModel:
    """Return the model of a URDF text, built once per text and process."""
    return RobotModel(urdf)
