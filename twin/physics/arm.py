"""The robot in PyBullet: its description as PyBullet should load it, motors, fingers and links."""

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from bridge.geometry import se3
from bridge.robots.robot import Finger, Mimic, Robot, mimics_of, robot_of
from twin.errors import TwinError
from twin.physics.config import FINGER_SPEED_M_S, PhysicsConfig
from twin.physics.engine import Client, pybullet

# The robot description as PyBullet should load it.
# PyBullet gives links without ``<inertial>`` a mass of 1 kg, massless frames included, and makes
# its own hulls of meshes; both are settled here so that it simulates the robot that was described.

_TINY_INERTIAL = (
    '<inertial><mass value="0.001"/>'
    '<inertia ixy="0" ixz="0" iyz="0" ixx="1e-06" iyy="1e-06" izz="1e-06"/></inertial>'
)

Hulls = Mapping[str, Sequence[Float[np.ndarray, "num_points 3"]]]


def write_description(urdf: str, mesh_hulls_m: Hulls, folder: Path) -> Path:
    """Write ``robot.urdf`` (returned) with hulls [m, link's frame] for its collision meshes.

    Visuals are gone already (``with_absolute_meshes``).
    """
    root = ET.fromstring(urdf)
    for number, link in enumerate(root.findall("link")):
        if link.find("inertial") is None:
            link.append(ET.fromstring(_TINY_INERTIAL))
        hulls = mesh_hulls_m.get(link.get("name", ""), ())
        if hulls:  # by number: a name may hold a slash
            _replace_meshes(link, hulls, folder, f"link_{number}")
    path = folder / "robot.urdf"
    path.write_text(ET.tostring(root, encoding="unicode"))
    return path


def _replace_meshes(
    link: ET.Element, hulls: Sequence[Float[np.ndarray, "num_points 3"]], folder: Path, stem: str
) -> None:
    for collision in link.findall("collision"):
        if collision.find("geometry/mesh") is not None:
            link.remove(collision)
    for index, points in enumerate(hulls):
        path = folder / f"{stem}_{index}.obj"
        path.write_text(_obj_of(np.asarray(points, dtype=np.float64).tobytes()))
        collision = ET.SubElement(link, "collision")
        geometry = ET.SubElement(collision, "geometry")
        ET.SubElement(geometry, "mesh", filename=str(path))


@lru_cache(maxsize=64)
def _obj_of(points: bytes) -> str:
    """Every world of a process loads the same robot: its hulls are written out once."""
    points_m = np.frombuffer(points).reshape(-1, 3)
    triangles = ConvexHull(points_m).simplices + 1
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points_m]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles]
    return "\n".join(lines) + "\n"


SLOWEST_M_S = 1e-4
"""Stalled fingers still creep this fast: PyBullet takes a speed of 0 for no limit."""
_GAIN, _PRESS_GAIN = 0.1, 1.0
"""Share of the way to the target that fingers would go in one step, if they were fast enough:
PyBullet's own, and one with which fingers that press ask for their whole speed."""

Joints = list[float] | Float[np.ndarray, " num_joints"]
"""One value per joint of the arm; a list costs less than an array."""

LinkPose = tuple[tuple[float, ...], tuple[float, ...]]
"""Position [m] and quaternion xyzw of a link's frame, as PyBullet has them."""


class PhysicsError(TwinError):
    """The physics engine refused or lost something."""


@dataclass(frozen=True)
class _Drive:
    """A finger joint with a motor: one of the record's, or one that mimics one of them."""

    index: int
    finger: Finger
    multiplier: float = 1.0
    offset: float = 0.0

    def value(self, width_m: float) -> float:
        """Where the joint is at a distance between the pads."""
        return self.multiplier * self.finger.value(width_m) + self.offset

    def width_m(self, value: float) -> float:
        """The distance between the pads at a value of the joint."""
        return self.finger.width((value - self.offset) / self.multiplier)

    def slope(self, width_m: float) -> float:
        """Change of the value with the width."""
        return self.multiplier * self.finger.slope(width_m)


def require_parts(record: Robot, joints: Collection[str], links: Collection[str]) -> None:
    """Refuse (PhysicsError) a description that lacks a part of the robot's arm or fingers."""
    missing = [name for name in (*record.joints, *record.finger_joints) if name not in joints]
    tool = (record.tool_frame, *record.gripper.finger_links)
    missing += [name for name in tool if name not in links]
    if missing:
        raise PhysicsError(
            f"the robot description lacks {', '.join(missing)}; it has the joints "
            f"{', '.join(joints)}. Physics needs the arm and the fingers of {record.name!r}."
        )


class Arm:
    """One robot with its base at the origin of a PyBullet client."""

    def __init__(
        self, client: Client, urdf: str, mesh_hulls_m: Hulls, config: PhysicsConfig
    ) -> None:
        """Load it."""
        self._client = client
        self._config = config
        self.record: Robot = robot_of(urdf)
        self._max_width_m = self.record.gripper.max_width_m
        self.id = self._load(urdf, mesh_hulls_m)
        self._index_joints(mimics_of(urdf))
        self._couple_fingers()
        self._target_m = self._max_width_m
        self._arm_order: tuple[list[float], ...] | None = None
        self._finger_order: tuple[float, float, float] | None = None
        self._press_m_s: float | None = None
        self.closing = False
        """Whether the fingers were told to be narrower than before, and not wider since."""

    def _load(self, urdf: str, mesh_hulls_m: Hulls) -> int:
        with tempfile.TemporaryDirectory(prefix="robot-gst-physics-") as folder:
            path = write_description(urdf, mesh_hulls_m, Path(folder))
            try:
                flags = pybullet.URDF_USE_INERTIA_FROM_FILE
                return int(self._client.loadURDF(str(path), useFixedBase=True, flags=flags))
            except pybullet.error as error:
                raise PhysicsError(
                    f"PyBullet does not load the robot description ({error}). "
                    "Check its links and collision meshes."
                ) from error

    def _index_joints(self, mimics: Sequence[Mimic]) -> None:
        record, gripper = self.record, self.record.gripper
        self._joints: dict[str, int] = {}
        self.links: dict[str, int] = {}
        self._efforts: dict[str, float] = {}
        self.opening_axes: dict[str, tuple[float, ...]] = {}
        parents: dict[str, int] = {}
        fixed: set[int] = {-1}
        for index in range(self._client.getNumJoints(self.id)):
            item = self._client.getJointInfo(self.id, index)
            self._joints[item[1].decode()] = index
            self.links[item[12].decode()] = index
            self._efforts[item[1].decode()] = item[10]
            self.opening_axes[item[12].decode()] = tuple(item[13])
            parents[item[12].decode()] = item[16]
            if item[2] == pybullet.JOINT_FIXED and item[16] in fixed:
                fixed.add(index)
        self.base_links = tuple(sorted(fixed - {-1}))
        """What no joint moves."""
        require_parts(record, self._joints, self.links)
        self._arm = [self._joints[name] for name in record.joints]
        self._drives = self._driven(mimics)
        self._fingers = [drive.index for drive in self._drives]
        self.finger_links = [self.links[name] for name in gripper.finger_links]
        carriers = [parents[name] for name, index in self.links.items() if index in self._fingers]
        self._finger_parent = carriers[0] if carriers else self.links[record.tool_frame]
        self._arm_forces = [self._efforts[name] for name in record.joints]
        for name, index in self.links.items():
            if index in self._fingers:
                self.opening_axes[name] = self._opening(name, index)

    def _driven(self, mimics: Sequence[Mimic]) -> list[_Drive]:
        """The joints that open the gripper, leaders and followers."""
        leaders = {item.joint: item for item in self.record.gripper.fingers}
        drives = [_Drive(self._joints[name], finger) for name, finger in leaders.items()]
        return drives + [
            _Drive(self._joints[item.joint], leaders[item.leader], item.multiplier, item.offset)
            for item in mimics
            if item.leader in leaders and item.joint not in leaders
        ]

    def _opening(self, name: str, index: int) -> tuple[float, ...]:
        """Direction in which a finger's pad goes when the gripper opens, in the finger's frame."""
        item = self._client.getJointInfo(self.id, index)
        drive = next(drive for drive in self._drives if drive.index == index)
        opens = 1.0 if drive.slope(self._max_width_m / 2) > 0 else -1.0
        axis = np.array(item[13]) * opens
        if item[2] == pybullet.JOINT_REVOLUTE:
            T_finger_base = se3.invert(self.T_base_link(name))
            pad = se3.apply(T_finger_base, self.T_base_link(self.record.tool_frame)[:3, 3])
            axis = np.cross(axis, pad)
            axis /= np.linalg.norm(axis)
        return tuple(axis.tolist())

    def _couple_fingers(self) -> None:
        for link in self.finger_links:
            self._client.changeDynamics(self.id, link, lateralFriction=self._config.finger_friction)
        if len(self._fingers) != 2:
            return
        first, second = (drive.slope(self._max_width_m / 2) for drive in self._drives)
        ends, zero = (self.id, self._fingers[0], self.id, self._fingers[1]), [0, 0, 0]
        gear = self._client.createConstraint(*ends, pybullet.JOINT_GEAR, [0, 1, 0], zero, zero)
        self._client.changeConstraint(
            gear, gearRatio=-first / second, erp=0.2, maxForce=10 * self._config.grip_force_N
        )

    def reset(self, joints_rad: Joints, width_m: float, rad_s: Joints | None = None) -> None:
        """Put the robot into a posture, at rest or at a speed, without simulating."""
        speeds = np.zeros(len(self._arm)) if rad_s is None else rad_s
        for index, value, speed in zip(self._arm, joints_rad, speeds, strict=True):
            self._client.resetJointState(self.id, index, float(value), float(speed))
        for drive in self._drives:
            self._client.resetJointState(self.id, drive.index, drive.value(float(width_m)), 0.0)

    def command(self, joints_rad: Joints, velocity_rad_s: Joints, width_m: float) -> None:
        """Set the targets the motors follow from the next step on; the width as far as it goes.

        Motors keep their orders: one that is already followed is not given again.
        """
        order = (_numbers(joints_rad), _numbers(velocity_rad_s), self._arm_forces)
        if order != self._arm_order:
            self._client.setJointMotorControlArray(
                self.id,
                self._arm,
                pybullet.POSITION_CONTROL,
                targetPositions=order[0],
                targetVelocities=order[1],
                forces=self._arm_forces,
            )
            self._arm_order = order
        target_m = min(max(width_m, 0.0), self._max_width_m)
        if target_m > self._target_m:
            self.closing, self._press_m_s = False, None
        elif target_m < self._target_m:
            self.closing = True
        self._target_m = target_m
        self._close_fingers()

    def soften(self, most_Nm: Joints, carrying_Nm: Joints) -> None:
        """Let the arm's motors be no stronger than so much, beside what carries it for a step."""
        self._arm_forces, carried = _numbers(most_Nm), _numbers(carrying_Nm)
        mode = pybullet.TORQUE_CONTROL
        self._client.setJointMotorControlArray(self.id, self._arm, mode, forces=carried)

    def _close_fingers(self) -> None:
        press = self._press_m_s
        speed_m_s, gain = (FINGER_SPEED_M_S, _GAIN) if press is None else (press, _PRESS_GAIN)
        self._drive_fingers(self._target_m, speed_m_s, gain)

    def press(self, speed_m_s: float | None) -> None:
        """Drive the fingers to their target with another speed; None: with the usual one."""
        if speed_m_s != self._press_m_s:
            self._press_m_s = speed_m_s
            self._close_fingers()

    def fingers(self) -> list[tuple[float, float]]:
        """How far each finger is from being as closed as it was told [m], and its speed [m/s]."""
        states = self._client.getJointStates(self.id, self._fingers)
        share, found = 1.0 / len(self._drives), []
        for drive, state in zip(self._drives, states, strict=True):
            width_m = drive.width_m(state[0])
            speed_m_s = state[1] / drive.slope(width_m)
            found.append((share * (width_m - self._target_m), share * speed_m_s))
        return found

    def _drive_fingers(self, target_m: float, speed_m_s: float, gain: float = _GAIN) -> None:
        order = (target_m, speed_m_s, gain)
        if self._finger_order == order:
            return
        self._finger_order = order
        for drive in self._drives:
            # Of the width each finger has its share; what a joint does per metre of that.
            lever = len(self._drives) * abs(drive.slope(target_m))
            self._client.setJointMotorControl2(
                self.id,
                drive.index,
                pybullet.POSITION_CONTROL,
                targetPosition=drive.value(target_m),
                force=self._config.grip_force_N / lever,
                maxVelocity=speed_m_s * lever,
                positionGain=gain,
            )

    def yield_fingers(self, reaction_N: float) -> None:
        """Let what is soft between the fingers slow, stall or push back their drive.

        The line of a geared motor: the speed falls with the load and is zero at the grip force.
        Why not a force: docs/decisions/0017-contact-physics.md.
        """
        top, here = FINGER_SPEED_M_S, self.width_m()
        speed = top * (1.0 - reaction_N / self._config.grip_force_N)
        if self._target_m >= here:
            self._drive_fingers(self._target_m, top)
        elif speed >= 0:
            self._drive_fingers(self._target_m, max(speed, SLOWEST_M_S))
        else:
            self._drive_fingers(self._max_width_m, min(-speed, top))

    def width_m(self) -> float:
        """Distance between the finger pads, mean of what each finger says; 0 of a fixed tool."""
        return self.posture()[1]

    def posture(self) -> tuple[Float[np.ndarray, " num_joints"], float]:
        """Where the arm is, and the distance between the finger pads; one question for both."""
        states = self._client.getJointStates(self.id, [*self._arm, *self._fingers])
        places = [state[0] for state in states]
        arm, fingers = np.array(places[: len(self._arm)]), places[len(self._arm) :]
        widths = [drive.width_m(at) for drive, at in zip(self._drives, fingers, strict=True)]
        return arm, float(sum(widths)) / len(widths) if widths else 0.0

    def link_poses(self, links: Sequence[int]) -> list[LinkPose]:
        """Position [m] and quaternion xyzw of the frames of links, base frame."""
        states = self._client.getLinkStates(self.id, links, computeForwardKinematics=1)
        return [(state[4], state[5]) for state in states]

    def T_base_link(self, link: str) -> Float[np.ndarray, "4 4"]:
        """Pose of a link's frame."""
        p, (x, y, z, w) = self.link_poses([self.links[link]])[0]
        return se3.transform_from(np.array([w, x, y, z]), np.array(p))

    def push(
        self, link: str | None, force_N: tuple[float, ...], point_m: tuple[float, ...]
    ) -> None:
        """Apply a force at a point (base frame) in the next step; None: to the fingers' parent."""
        self._client.applyExternalForce(
            self.id,
            self._finger_parent if link is None else self.links[link],
            force_N,
            point_m,
            pybullet.WORLD_FRAME,
        )


def _numbers(joints: Joints) -> list[float]:
    return joints if isinstance(joints, list) else joints.tolist()


# Stalled fingers are driven faster: the same force in fewer iterations of the solver. What they
# hold may give way: then they are at the usual speed again before they have gone far.
# docs/decisions/0017-contact-physics.md.

PRESS_M_S = 0.8
"""Speed with which stalled fingers are driven; until somebody looks they go 7 mm at most."""
STALLED_M_S = 0.02
"""Fingers slower than this are stopped by something."""
SHORT_M = 0.0005
"""Fingers this near to where they were told to be have arrived there."""
EVERY_STEPS = 2
"""How often fingers are asked."""
PATIENCE = 2
"""So many times they must have been found to be stopped."""


class Press:
    """Watches the fingers of an arm."""

    def __init__(self, arm: Arm) -> None:
        """Start with fingers at their usual speed."""
        self._arm = arm
        self._steps = 0
        self._found = 0

    def update(self, *, anew: bool) -> None:
        """Drive the fingers for the next step, once per step; anew: contacts may be missing yet."""
        self._steps += 1
        if anew:
            self._found = 0
            self._arm.press(None)
        elif self._arm.closing and self._steps % EVERY_STEPS == 0:
            stalled = bool(self._arm.finger_links) and all(
                short_m > SHORT_M and abs(speed_m_s) < STALLED_M_S
                for short_m, speed_m_s in self._arm.fingers()
            )
            self._found = self._found + 1 if stalled else 0
            self._arm.press(PRESS_M_S if self._found >= PATIENCE else None)
        elif not self._arm.closing:
            self._found = 0
