"""One simulated cell in MuJoCo: the second engine, for rigid bodies.

Robot, boxes, masses and commands are those of ``twin.physics.world``. What differs is how contact
is solved: MuJoCo minimises over all contact forces at once and lets bodies sink in a little, so its
grasps neither slip as PyBullet's do nor fail where its iterations end.
"""

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NoReturn

import mujoco
import numpy as np
from jaxtyping import Float

from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.robots.robot import Robot, mimics_of, robot_of
from twin.physics.arm import Hulls, Joints, PhysicsError, require_parts, write_description
from twin.physics.config import FINGER_SPEED_M_S, RIGID_ONLY, PhysicsConfig, Unseen
from twin.physics.unseen import EVEN, box_inertia, solids
from twin.physics.world import TABLE_M, Box

STEP_HZ = 480
"""The engine takes whole steps in each period of control, at least so many a second: at fewer the
motors shake."""
LINK_FRICTION = 0.5
"""Of links other than fingers; what PyBullet gives to links without a coefficient."""
_ARM_RAD_S = 100.0
"""Natural frequency of the arm's controller, critically damped; the largest that stays well below
one radian in each step."""
_FINGER_N_M = 20_000.0
"""Stiffness of a finger's drive: its whole force within a millimetre of where it should be."""
_FINGER_N_s_m = 80.0
_FINGER_ARMATURE_KG = 0.2
"""Reflected inertia of a finger's motor; light fingers would shake at this step."""
_CONTACT = {"solref": (0.005, 1.0), "solimp": (0.95, 0.99, 0.0005, 0.5, 2.0)}
"""Contact as hard as the step allows: 20 N sink in by less than 0.1 mm."""
_IMPRATIO = 10.0
"""Friction is held so much more stiffly than contact: what is grasped does not creep."""
_OBJECT = "object/"
_HULLS_AND_FIXED_LINKS = {
    "fusestatic": "false",
    "strippath": "false",
    "discardvisual": "false",
    "balanceinertia": "false",
}


@lru_cache(maxsize=4)
def _robot_spec(urdf: str, hulls: tuple[tuple[str, tuple[bytes, ...]], ...]) -> Any:
    """The robot as MuJoCo reads the description that PyBullet gets too; copy it before use."""
    points = {link: [np.frombuffer(raw).reshape(-1, 3) for raw in raws] for link, raws in hulls}
    with tempfile.TemporaryDirectory(prefix="robot-gst-physics-") as folder:
        root = ET.fromstring(write_description(urdf, points, Path(folder)).read_text())
        ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", _HULLS_AND_FIXED_LINKS)
        assets = {str(path): path.read_bytes() for path in Path(folder).glob("*.obj")}
        try:
            spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"), assets=assets)
            spec.copy().compile()
        except ValueError as error:
            raise PhysicsError(
                f"MuJoCo does not load the robot description ({error}). "
                "Check its links and collision meshes."
            ) from error
    return spec


class MujocoArm:
    """The robot of one world."""

    def __init__(self, spec: Any, record: Robot, config: PhysicsConfig) -> None:
        """Give the joints motors."""
        links = [body.name for body in spec.bodies]
        require_parts(record, [joint.name for joint in spec.joints], links)
        self._record, self._config = record, config
        self._drives = record.gripper.fingers
        self._model: Any = None
        self._data: Any = None
        # Until it is told otherwise it stays where the description puts it.
        self._target_rad: Any = np.zeros(len(record.joints))
        self._speed_rad_s: Any = np.zeros(len(record.joints))
        self._target_m = self._ramp_m = 0.0
        efforts = np.array([float(spec.joint(name).actfrcrange[1]) for name in record.joints])
        self._driven = efforts > 0
        for name, effort in zip(record.joints, efforts.tolist(), strict=True):
            _add_motor(spec, name, effort)
        for finger in self._drives:
            joint, force = spec.joint(finger.joint), config.grip_force_N
            joint.armature, joint.actfrcrange = _FINGER_ARMATURE_KG, [-force, force]
            motor = _add_motor(spec, finger.joint, force)
            motor.set_to_position(kp=_FINGER_N_M, kv=_FINGER_N_s_m)
        for first, other in pairwise(self._drives):  # they move together, as by a gear
            gear = spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT, name1=other.joint, name2=first.joint
            )
            ratio = other.per_m / first.per_m
            gear.data[:5] = [other.closed - ratio * first.closed, ratio, 0.0, 0.0, 0.0]
            gear.solref = _CONTACT["solref"]

    def bind(self, model: Any, data: Any) -> None:
        """Take the compiled world; call again when it was compiled again."""
        self._model, self._data = model, data
        joints = [model.joint(name) for name in self._record.joints]
        fingers = [model.joint(finger.joint) for finger in self._drives]
        self._arm = np.array([int(joint.qposadr[0]) for joint in joints])
        self._arm_dofs = np.array([int(joint.dofadr[0]) for joint in joints])
        self._fingers = np.array([int(joint.qposadr[0]) for joint in fingers], dtype=int)
        self._finger_dofs = np.array([int(joint.dofadr[0]) for joint in fingers], dtype=int)
        self._wanted, self._torques = np.zeros(model.nv), np.zeros(model.nv)

    def reset(self, joints_rad: Joints, width_m: float, rad_s: Joints | None = None) -> None:
        """Put the robot into a posture, at rest or at a speed, without simulating."""
        data, rest = self._data, np.zeros(len(self._arm))
        data.qpos[self._arm] = joints_rad
        data.qvel[self._arm_dofs] = rest if rad_s is None else rad_s
        data.qpos[self._fingers] = [finger.value(width_m) for finger in self._drives]
        data.qvel[self._finger_dofs] = 0.0
        self._ramp_m = width_m
        self.command(joints_rad, rest, width_m)
        mujoco.mj_forward(self._model, data)

    def command(self, joints_rad: Joints, velocity_rad_s: Joints, width_m: float) -> None:
        """Set the position targets that the motors follow from the next step on."""
        self._target_rad, self._speed_rad_s = np.asarray(joints_rad), np.asarray(velocity_rad_s)
        self._target_m = min(max(width_m, 0.0), self._record.gripper.max_width_m)

    def drive(self, left_s: float) -> None:
        """Set the motors for one step at known state; the command is due ``left_s`` after it."""
        data, count = self._data, len(self._arm)
        # Computed torque: what moves the arm as it should, gravity and inertia taken out.
        far = self._target_rad - left_s * self._speed_rad_s - data.qpos[self._arm]
        slow = self._speed_rad_s - data.qvel[self._arm_dofs]
        wanted = _ARM_RAD_S * (_ARM_RAD_S * far + 2.0 * slow)
        self._wanted[self._arm_dofs] = np.where(self._driven, wanted, 0.0)
        mujoco.mj_mulM(self._model, data, self._torques, self._wanted)
        data.ctrl[:count] = (self._torques + data.qfrc_bias)[self._arm_dofs]
        # A ramp as fast as both fingers may be, no farther from them than their force reaches.
        config, here = self._config, self.width_m()
        stride = 2.0 * FINGER_SPEED_M_S * float(self._model.opt.timestep)
        reach = 2.0 * config.grip_force_N / _FINGER_N_M
        ramp = self._ramp_m + min(max(self._target_m - self._ramp_m, -stride), stride)
        self._ramp_m = min(max(ramp, here - reach), here + reach)
        data.ctrl[count:] = [finger.value(self._ramp_m) for finger in self._drives]

    def posture(self) -> tuple[Float[np.ndarray, " num_joints"], float]:
        """Where the arm is, and the distance between the finger pads."""
        return np.array(self._data.qpos[self._arm]), self.width_m()

    def width_m(self) -> float:
        """Distance between the finger pads."""
        values = self._data.qpos[self._fingers].tolist()
        widths = [finger.width(value) for value, finger in zip(values, self._drives, strict=True)]
        return float(sum(widths) / len(widths)) if widths else 0.0


def _refuse_gripper(record: Robot, urdf: str) -> None:
    """Refuse (PhysicsError) fingers that turn, follow a lever, or mimic another one."""
    fingers = record.gripper.fingers
    followers = [item.joint for item in mimics_of(urdf) if item.leader in record.finger_joints]
    others = [item.joint for item in fingers if item.turns or item.link_m]
    unfit = others + [name for name in followers if name not in record.finger_joints]
    if unfit:
        raise PhysicsError(
            f"MuJoCo replays fingers that slide, each with a motor of its own; of {record.name!r} "
            f"{', '.join(unfit)} turns or follows another joint. Use --engine pybullet."
        )


def _add_motor(spec: Any, joint: str, most: float) -> Any:
    """Let a motor act on a joint, with so much force or torque at most."""
    motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    if most > 0:
        motor.forcelimited, motor.forcerange = True, [-most, most]
    else:  # a joint without effort is passive
        motor.gainprm[0] = 0.0
    return motor


@dataclass(frozen=True, kw_only=True)
class _Shape:
    """One solid, and what may meet it."""

    name: str
    friction: float
    owner: Literal["robot", "static", "object"]
    on_table: bool = False
    """Of the robot's base, which touches the table by construction."""
    table: bool = False
    body: str = ""
    """Which object it is a part of."""

    def meets(self, other: "_Shape") -> bool:
        """Whether contact between the two counts: something of a pair must move by itself."""
        if self.owner == other.owner:
            return self.owner == "object" and self.body != other.body
        return not ((self.on_table and other.table) or (self.table and other.on_table))


class MujocoWorld(AbstractContextManager["MujocoWorld"]):
    """One simulated cell. A context manager, as every world; there is nothing to free."""

    def __init__(self, urdf: str, mesh_hulls_m: Hulls, config: PhysicsConfig) -> None:
        """Load the robot with its base at the origin."""
        self.config = config
        hulls = tuple(
            (link, tuple(np.asarray(points, dtype=np.float64).tobytes() for points in several))
            for link, several in mesh_hulls_m.items()
        )
        self._spec = _robot_spec(urdf, hulls).copy()
        option = self._spec.option
        self._num_steps = -(-STEP_HZ // config.rate_hz)
        option.timestep = 1.0 / (config.rate_hz * self._num_steps)
        option.gravity = [0.0, 0.0, -config.gravity_m_s2]
        option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = _IMPRATIO
        self._record = robot_of(urdf)
        _refuse_gripper(self._record, urdf)
        self.robot = MujocoArm(self._spec, self._record, config)
        self.free_objects: list[str] = []
        self._shapes: list[_Shape] = []
        self._add_robot_shapes()
        self._model: Any = None
        self._data: Any = None
        self._compile()

    def soft_bodies(self) -> NoReturn:
        """Soft bodies, which this engine does not replay."""
        raise UsageError(RIGID_ONLY)

    def _add_robot_shapes(self) -> None:
        for body in self._spec.bodies:
            finger = body.name in self._record.gripper.finger_links
            mu = self.config.finger_friction if finger else LINK_FRICTION
            for index, geom in enumerate(body.geoms):
                geom.name = f"{body.name}/{index}"
                # Only explicit pairs have the product of two coefficients; nothing else meets.
                geom.contype = geom.conaffinity = 0
                on_table = body.name in (self._record.base_frame, "world")
                self._shapes.append(
                    _Shape(name=geom.name, friction=mu, owner="robot", on_table=on_table)
                )

    def add_table(self, height_m: float) -> None:
        """Add the table: a slab whose top is at the height."""
        T = np.eye(4)
        T[2, 3] = height_m - TABLE_M[2] / 2
        self._add_static(np.array(TABLE_M), T, table=True)

    def add_static(self, boxes: Sequence[Box], T_base_owner: Float[np.ndarray, "4 4"]) -> None:
        """Add solid boxes that never move."""
        for centre, extents in boxes:
            T_owner_box = np.eye(4)
            T_owner_box[:3, 3] = centre
            self._add_static(extents, T_base_owner @ T_owner_box, table=False)

    def _add_static(
        self, size_m: Float[np.ndarray, "3"], T: Float[np.ndarray, "4 4"], *, table: bool
    ) -> None:
        q, p = se3.split(T)
        name = f"static/{len(self._shapes)}"
        self._spec.worldbody.add_geom(name=name, pos=p, quat=q, **_box(size_m))
        friction = self.config.surface_friction
        self._pair(_Shape(name=name, friction=friction, owner="static", table=table))

    def add_free(
        self,
        object_id: str,
        size_m: Float[np.ndarray, "3"],
        mass_kg: float,
        T_base_object: Float[np.ndarray, "4 4"],
        unseen: Unseen = EVEN,
    ) -> None:
        """Add a solid box that moves."""
        q, p = se3.split(T_base_object)
        name = _OBJECT + object_id
        body = self._spec.worldbody.add_body(name=name, pos=p, quat=q)
        body.add_freejoint(name=name)
        if unseen != EVEN:
            body.explicitinertial, body.mass = True, mass_kg
            body.ipos, body.inertia = unseen.centre_of_mass_m, box_inertia(size_m, mass_kg)
        boxes = solids(unseen, size_m)
        shapes = [f"{name}/{k}" if k else name for k in range(len(boxes))]
        for shape, extents in zip(shapes, boxes, strict=True):
            body.add_geom(name=shape, mass=mass_kg, **_box(extents))
        self.free_objects.append(object_id)
        for shape in shapes:
            friction = self.config.object_friction
            self._pair(_Shape(name=shape, friction=friction, owner="object", body=object_id))

    def _pair(self, shape: _Shape) -> None:
        """Let a shape meet those that are there already."""
        for other in self._shapes:
            if shape.meets(other):
                mu = shape.friction * other.friction
                pair = self._spec.add_pair(geomname1=other.name, geomname2=shape.name, condim=3)
                pair.friction[:2] = mu
                pair.solref, pair.solimp = _CONTACT["solref"], _CONTACT["solimp"]
        self._shapes.append(shape)
        self._changed = True

    def _compile(self) -> None:
        """Compile what was added; what is there already stays where it is."""
        if self._model is None:
            self._model = self._spec.compile()
            self._data = mujoco.MjData(self._model)
        else:
            self._model, self._data = self._spec.recompile(self._model, self._data)
        self._changed = False
        self.robot.bind(self._model, self._data)
        self._addresses = {
            name: int(self._model.joint(_OBJECT + name).qposadr[0]) for name in self.free_objects
        }
        self._geoms: dict[str, set[int]] = {name: set() for name in self.free_objects}
        for shape in self._shapes:
            if shape.owner == "object":
                self._geoms[shape.body].add(int(self._model.geom(shape.name).id))
        robot = [shape.name for shape in self._shapes if shape.owner == "robot"]
        self._robot_geoms = {int(self._model.geom(name).id): name for name in robot}
        fingers = self._record.gripper.finger_links
        self._finger_geoms = {
            k for k, name in self._robot_geoms.items() if name.rpartition("/")[0] in fingers
        }
        mujoco.mj_forward(self._model, self._data)

    def reset_robot(self, joints_rad: Joints, width_m: float, rad_s: Joints | None = None) -> None:
        """Put the robot into a posture, at rest or at a speed, without simulating."""
        if self._changed:
            self._compile()
        self.robot.reset(joints_rad, width_m, rad_s)

    def step(self) -> None:
        """Advance by one control period."""
        if self._changed:
            self._compile()
        for left in reversed(range(self._num_steps)):
            mujoco.mj_step1(self._model, self._data)
            self.robot.drive(left * float(self._model.opt.timestep))
            mujoco.mj_step2(self._model, self._data)

    def object_pose(self, object_id: str) -> tuple[float, ...]:
        """Position [m] and quaternion wxyz of an object that moves, seven numbers."""
        start = self._address(object_id)
        # Not the body's frame, which is that of before the last step.
        return tuple(self._data.qpos[start : start + 7].tolist())

    def T_base_object(self, object_id: str) -> Float[np.ndarray, "4 4"]:
        """Pose of an object that moves."""
        pose = np.array(self.object_pose(object_id))
        return se3.transform_from(pose[3:], pose[:3])

    def finger_touches(self, object_id: str) -> bool:
        """Whether a finger is in contact with an object that moves."""
        self._address(object_id)
        mine = self._geoms[object_id]
        return any(
            (first in mine and second in self._finger_geoms)
            or (second in mine and first in self._finger_geoms)
            for first, second in self._data.contact.geom.tolist()
        )

    def arm_force_N(self) -> float:
        """Size of the force that rigid bodies exert on the arm in all; a grasp's cancel out."""
        total, force = np.zeros(3), np.zeros(6)
        for index, (first, second) in enumerate(self._data.contact.geom.tolist()):
            mujoco.mj_contactForce(self._model, self._data, index, force)
            # In the contact's axes, on the second shape: the first axis leads from first to second.
            pushed = self._data.contact.frame[index].reshape(3, 3).T @ force[:3]
            total += pushed if second in self._robot_geoms else 0.0
            total -= pushed if first in self._robot_geoms else 0.0
        return float(np.linalg.norm(total))

    def _address(self, object_id: str) -> int:
        if self._changed:
            self._compile()
        if object_id not in self._addresses:
            known = ", ".join(self.free_objects) or "none"
            raise PhysicsError(f"no object {object_id!r} moves in this world. There are: {known}.")
        return self._addresses[object_id]

    def __exit__(self, *_: object) -> None:
        """Nothing to free: model and data go with the world."""


def _box(size_m: Float[np.ndarray, "3"]) -> dict[str, Any]:
    return {
        "type": mujoco.mjtGeom.mjGEOM_BOX,
        "size": (np.asarray(size_m) / 2).tolist(),
        "contype": 0,
        "conaffinity": 0,
    }
