"""The laboratory in motion: MuJoCo stepped, commanded and read in our own terms."""

import xml.etree.ElementTree as ET
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bridge.geometry import se3
from bridge.robots.default import (
    ARM_JOINTS,
    BASE_FRAME,
    FINGER_JOINTS,
    FINGER_LINKS,
    MAX_WIDTH_M,
    ROBOT,
    TCP_FRAME,
)
from bridge.robots.robot import resolve_mesh
from bridge.sources.standin.cell_file import Clutter, HiddenParameters
from bridge.sources.standin.deviations import Deviations, parts_of
from bridge.sources.standin.soft import SoftBody, soft_body, soft_model_xml
from bridge.task.task_file import ObjectModel, Task


@dataclass(frozen=True, kw_only=True, eq=False)
class LinkShape:
    """One solid of a link: a mesh file or a box; itself alone is equal to it."""

    T_link_shape: Float[np.ndarray, "4 4"]
    mesh: str | None
    box_m: tuple[float, float, float] | None


@dataclass(frozen=True, kw_only=True)
class LinkModel:
    """One link with the joint that carries it."""

    name: str
    parent: str | None
    joint: str | None
    joint_type: str
    axis: tuple[float, float, float]
    limits: tuple[float, float]
    T_parent_link: Float[np.ndarray, "4 4"]
    mass_kg: float
    T_link_inertial: Float[np.ndarray, "4 4"]
    inertia_kgm2: Float[np.ndarray, "3 3"]
    shapes: tuple[LinkShape, ...]


@cache
def robot_links() -> tuple[LinkModel, ...]:
    """Return every link, parents before children, starting at ``base_link``."""
    root = ET.fromstring(ROBOT.urdf_text())
    elements = {item.attrib["name"]: item for item in root.findall("link")}
    joints = root.findall("joint")
    links = []
    waiting = [(BASE_FRAME, ET.Element("joint", type="fixed"))]
    while waiting:
        name, joint = waiting.pop(0)
        links.append(_link(elements[name], joint))
        for item in joints:
            if _child_of(item, "parent") == name:
                waiting.append((_child_of(item, "child"), item))
    return tuple(links)


def _child_of(joint: ET.Element, tag: str) -> str:
    found = joint.find(tag)
    return "" if found is None else found.attrib["link"]


def _link(element: ET.Element, joint: ET.Element) -> LinkModel:
    tensor, limit = element.find("inertial/inertia"), joint.find("limit")
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    xx, yy, zz, xy, xz, yz = (_number(tensor, name) for name in names)
    return LinkModel(
        name=element.attrib["name"],
        parent=_child_of(joint, "parent") or None,
        joint=joint.get("name"),
        joint_type=joint.attrib["type"],
        axis=_vector(joint.find("axis"), "xyz", "1 0 0"),
        limits=(_number(limit, "lower"), _number(limit, "upper")),
        T_parent_link=_origin(joint),
        mass_kg=_number(element.find("inertial/mass"), "value"),
        T_link_inertial=_origin(element.find("inertial")),
        inertia_kgm2=np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
        shapes=tuple(_shapes(element)),
    )


def _shapes(element: ET.Element) -> list[LinkShape]:
    shapes = []
    for collision in element.findall("collision"):
        mesh, box = collision.find("geometry/mesh"), collision.find("geometry/box")
        if mesh is not None:
            path = str(resolve_mesh(mesh.attrib["filename"]))
            shapes.append(LinkShape(T_link_shape=_origin(collision), mesh=path, box_m=None))
        elif box is not None and element.attrib["name"] != "ee_link":
            # ee_link holds a 1 cm marker box inside the flange, not a part of the robot.
            size = _vector(box, "size")
            shapes.append(LinkShape(T_link_shape=_origin(collision), mesh=None, box_m=size))
    return shapes


def _number(element: ET.Element | None, name: str) -> float:
    return 0.0 if element is None else float(element.get(name, "0"))


def _vector(
    element: ET.Element | None, name: str, default: str = "0 0 0"
) -> tuple[float, float, float]:
    text = default if element is None else element.get(name, default)
    x, y, z = (float(value) for value in text.split())
    return x, y, z


def _origin(element: ET.Element | None) -> Float[np.ndarray, "4 4"]:
    """Read ``<origin xyz rpy>``: fixed-axis roll, pitch, yaw as URDF defines it."""
    origin = None if element is None else element.find("origin")
    if origin is None:
        return np.eye(4)
    q = Rotation.from_euler("xyz", _vector(origin, "rpy")).as_quat(scalar_first=True)
    return se3.transform_from(q, np.array(_vector(origin, "xyz")))


def true_links(deviations: Deviations | None) -> tuple[LinkModel, ...]:
    """Return every link as it is, not as the URDF describes it; both agree without deviations."""
    if deviations is None:
        return robot_links()
    return tuple(_true_link(link, deviations) for link in robot_links())


def _true_link(link: LinkModel, deviations: Deviations) -> LinkModel:
    longer_m = deviations.link_length_m.get(link.name, 0.0)
    T = link.T_parent_link.copy()
    if longer_m:
        T[:3, 3] *= 1 + longer_m / np.linalg.norm(T[:3, 3])
    shapes = link.shapes
    if link.name in FINGER_LINKS:
        shapes = tuple(_true_pad(shape, deviations) for shape in shapes)
    return replace(link, T_parent_link=T, shapes=shapes)


def _true_pad(shape: LinkShape, deviations: Deviations) -> LinkShape:
    """A finger that is thicker outwards and longer at its tip, and sits to one side."""
    if shape.box_m is None:
        return shape
    x, y, z = shape.box_m
    thicker, longer = deviations.finger_thickness_m, deviations.finger_length_m
    T = shape.T_link_shape.copy()
    T[1, 3] += np.sign(T[1, 3]) * thicker / 2 + deviations.finger_shift_m
    T[2, 3] += longer / 2
    return replace(shape, T_link_shape=T, box_m=(x, y + thicker, z + longer))


STEP_S = 0.002
SOFT_STEP_S = 0.004
"""With soft objects: their integrator is implicit in position, and each step costs more."""
TABLE_SIZE_M = (1.3, 1.3, 0.04)
TABLE_CENTRE_M = (0.35, 0.0)
# Servo gains: stiff and critically damped on the large joints, softer on the wrist.
ARM_STIFFNESS = (9000.0, 9000.0, 6000.0, 2500.0, 2500.0, 1500.0)
ARM_DAMPING = (420.0, 420.0, 260.0, 70.0, 70.0, 40.0)
ARM_EFFORT_Nm = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
ARM_ARMATURE = 0.1
FINGER_STIFFNESS = 3000.0
FINGER_DAMPING = 60.0
FINGER_ARMATURE = 0.2
"""Reflected inertia of the gripper's motor [kg]; keeps the fingers calm at this step size."""
PAD_SOLREF = (0.005, 1.0)
PAD_SOLIMP = (0.95, 0.99, 0.0005, 0.5, 2.0)
"""Hard pads: a 20 N grip sinks in by some tenths of a millimetre, not by two."""

# Robot against world and world against world; the arm never collides with itself here.
_ROBOT_BITS = {"contype": 1, "conaffinity": 2}
_WORLD_BITS = {"contype": 2, "conaffinity": 3}


def build_model(task: Task, hidden: HiddenParameters, clutter: Sequence[Clutter] = ()) -> Any:
    """Compile the laboratory with its true parameters into an ``mjModel``."""
    if task.soft_objects:
        spec = mujoco.MjSpec.from_string(soft_model_xml(task, hidden))
        spec.option.timestep = SOFT_STEP_S
        # The only integrator that takes the elasticity of flexes.
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    else:
        spec = mujoco.MjSpec()
        spec.option.timestep = STEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0  # friction held stiffly: no creep of a grasped object
    spec.compiler.degree = False
    _add_robot(spec, hidden)
    _add_table(spec, hidden)
    for index, item in enumerate(clutter):
        _add_clutter(spec, item, index)
    for model in task.objects.values():
        if model.soft is None:
            _add_object(spec, model, hidden)
    _add_actuators(spec, hidden)
    spec.add_exclude(bodyname1="table", bodyname2=BASE_FRAME)
    return spec.compile()


def _add_robot(spec: Any, hidden: HiddenParameters) -> None:
    bodies: dict[str | None, Any] = {None: spec.worldbody}
    for link in true_links(hidden.deviations):
        q, p = se3.split(link.T_parent_link)
        body = bodies[link.parent].add_body(name=link.name, pos=p, quat=q, gravcomp=1.0)
        bodies[link.name] = body
        _set_inertia(body, link)
        _add_joint(body, link, hidden.deviations)
        for index, shape in enumerate(link.shapes):
            _add_shape(spec, body, shape, name=f"{link.name}_{index}", hidden=hidden)
        if link.name == TCP_FRAME:
            body.add_site(name=TCP_FRAME)


def _set_inertia(body: Any, link: LinkModel) -> None:
    body.explicitinertial = True
    p = link.T_link_inertial[:3, 3]
    if link.mass_kg > 0:
        R = link.T_link_inertial[:3, :3]
        tensor = R @ link.inertia_kgm2 @ R.T
        body.mass, body.ipos = link.mass_kg, p
        body.fullinertia = [
            tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        ]
    else:
        body.mass, body.inertia = 1e-3, [1e-6] * 3


def _add_joint(body: Any, link: LinkModel, deviations: Deviations | None) -> None:
    if link.joint_type == "fixed":
        return
    turns = link.joint_type == "revolute"
    drag_Nm = 0.0
    if deviations is not None and link.joint in ARM_JOINTS:
        drag_Nm = deviations.joint_drag_Nm[ARM_JOINTS.index(link.joint)]
    body.add_joint(
        name=link.joint,
        type=mujoco.mjtJoint.mjJNT_HINGE if turns else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=link.axis,
        range=link.limits,
        armature=ARM_ARMATURE if turns else FINGER_ARMATURE,
        frictionloss=drag_Nm,
    )


def _add_shape(
    spec: Any, body: Any, shape: LinkShape, *, name: str, hidden: HiddenParameters
) -> None:
    q, p = se3.split(shape.T_link_shape)
    settings: dict[str, Any] = {"name": name, "pos": p, "quat": q, **_ROBOT_BITS}
    if body.name in FINGER_LINKS:
        mu = hidden.finger_friction
        # Priority: the pads decide the friction of their contacts. Condim 4 resists twisting.
        settings |= {"priority": 2, "condim": 4, "friction": [mu, 0.01, 0.0001]}
        settings |= {"solref": PAD_SOLREF, "solimp": PAD_SOLIMP}
        if hidden.deviations is not None:
            settings["solref"] = (hidden.deviations.pad_time_s, 1.0)
    if shape.mesh is not None:
        spec.add_mesh(name=name, file=shape.mesh)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **settings)
    elif shape.box_m is not None:
        half = [extent / 2 for extent in shape.box_m]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, **settings)


def _add_table(spec: Any, hidden: HiddenParameters) -> None:
    x, y, z = TABLE_SIZE_M
    q, p = np.array([1.0, 0.0, 0.0, 0.0]), np.array([*TABLE_CENTRE_M, -z / 2])
    if hidden.deviations is not None:
        T_base_table = hidden.deviations.T_base_table
        q, p = se3.split(T_base_table)[0], se3.apply(T_base_table, p)
    body = spec.worldbody.add_body(name="table", pos=p, quat=q)
    body.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=[x / 2, y / 2, z / 2], **_WORLD_BITS
    )


def _add_object(spec: Any, model: ObjectModel, hidden: HiddenParameters) -> None:
    body = spec.worldbody.add_body(name=model.id, mocap=model.fixed, pos=[0, 0, 0.5])
    known = None if hidden.deviations is None else hidden.deviations.objects.get(model.id)
    parts = parts_of(model, known)
    volume = sum(float(np.prod(part.size_m)) for part in parts)
    for index, part in enumerate(parts):
        mass = model.mass_kg * hidden.mass_scale * float(np.prod(part.size_m)) / volume
        body.add_geom(
            name=f"{model.id}_{index}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=part.centre_m,
            quat=part.q_wxyz,
            size=part.size_m / 2,
            mass=mass,
            priority=1,
            condim=4,
            friction=[hidden.object_friction, 0.005, 0.0001],
            **_WORLD_BITS,
        )
    if known is not None and not model.fixed:
        size = np.array(model.size_m)
        mass_kg = model.mass_kg * hidden.mass_scale
        body.explicitinertial = True
        body.mass, body.ipos = mass_kg, np.array(known.centre_of_mass) * size / 2
        body.inertia = mass_kg / 12 * (np.sum(size**2) - size**2)
    if not model.fixed:
        body.add_freejoint(name=model.id)


def _add_clutter(spec: Any, item: Clutter, index: int) -> None:
    """A box around the thing; nothing is meant to touch it."""
    q, p = se3.split(item.T_base_clutter)
    spec.worldbody.add_geom(
        name=f"clutter_{index}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=p,
        quat=q,
        size=np.array(item.size_m) / 2,
        **_WORLD_BITS,
    )


def _add_actuators(spec: Any, hidden: HiddenParameters) -> None:
    for index, name in enumerate(ARM_JOINTS):
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=ARM_STIFFNESS[index], kv=ARM_DAMPING[index])
        actuator.forcelimited = True
        actuator.forcerange = [-ARM_EFFORT_Nm[index], ARM_EFFORT_Nm[index]]
    left, right = FINGER_JOINTS
    # One motor moves both fingers through a gear, as in a real parallel gripper: the second finger
    # follows the first, so the motor's force is the sum over both pads.
    equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=right, name2=left)
    equality.data[:5] = [0.0, 1.0, 0.0, 0.0, 0.0]
    equality.solref = [0.004, 1.0]
    actuator = spec.add_actuator(name="gripper", target=left, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=FINGER_STIFFNESS, kv=FINGER_DAMPING)
    actuator.forcelimited = True
    actuator.forcerange = [-2 * hidden.grip_N, 2 * hidden.grip_N]
    actuator.ctrllimited = True
    actuator.ctrlrange = [0.0, MAX_WIDTH_M / 2]


class World:
    """True state of the cell. Joint angles here are true ones, not encoder readings."""

    def __init__(
        self, task: Task, hidden: HiddenParameters, clutter: Sequence[Clutter] = ()
    ) -> None:
        """Build the model and stand still with the gripper open.

        ``task`` is then the one with the objects' true sizes, and ``clutter`` on the true table.
        """
        if hidden.deviations is not None:
            task = hidden.deviations.true_task(task)
            T = hidden.deviations.T_base_table
            clutter = [replace(item, T_base_clutter=T @ item.T_base_clutter) for item in clutter]
        self.task, self.clutter = task, clutter
        self._model: Any = build_model(task, hidden, clutter)
        self.step_s = float(self._model.opt.timestep)
        self._data: Any = mujoco.MjData(self._model)
        self._arm = [self._joint_address(name) for name in ARM_JOINTS]
        self._fingers = [self._joint_address(name) for name in FINGER_JOINTS]
        self._arm_dofs = [int(self._model.joint(name).dofadr[0]) for name in ARM_JOINTS]
        self._links = [link.name for link in robot_links() if link.shapes]
        self._link_bodies = [int(self._model.body(name).id) for name in self._links]
        self._finger_geoms = {int(self._model.geom(f"{name}_0").id) for name in FINGER_LINKS}
        own = {} if hidden.deviations is None else hidden.deviations.objects
        self._objects = {
            int(self._model.geom(f"{object_id}_{index}").id): object_id
            for object_id, model in task.objects.items()
            if model.soft is None
            for index in range(len(parts_of(model, own.get(object_id))))
        }
        """By the geoms of rigid ones."""
        self._soft: dict[str, SoftBody] = {
            object_id: soft_body(task.objects[object_id], self._model)
            for object_id in task.soft_objects
        }
        flex_type = mujoco.mjtObj.mjOBJ_FLEX
        self._flexes = {mujoco.mj_name2id(self._model, flex_type, key): key for key in self._soft}
        delay = max(round(hidden.latency_s / self.step_s), 0)
        self._pending: deque[np.ndarray] = deque(maxlen=delay + 1)
        self._play_rad = np.zeros(len(ARM_JOINTS))
        if hidden.deviations is not None:
            self._play_rad = np.array(hidden.deviations.joint_backlash_rad)
        self.slack_rad = np.zeros(len(ARM_JOINTS))
        """How far the arm's motors are ahead of their links within the play of the joints."""

    def _joint_address(self, name: str) -> int:
        return int(self._model.joint(name).qposadr[0])

    def reset(
        self,
        joints_rad: Float[np.ndarray, "6"],
        Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
    ) -> None:
        """Put the arm and the objects somewhere, at rest, gripper open."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[self._arm] = joints_rad
        self._data.qpos[self._fingers] = MAX_WIDTH_M / 2
        for object_id, T in Ts_base_object.items():
            q, p = se3.split(T)
            if object_id in self._soft:
                body = self._soft[object_id]
                moved_m = se3.apply(T, body.rest_nodes_m) - body.rest_nodes_m
                self._data.qpos[body.addresses] = moved_m
            elif self.task.objects[object_id].fixed:
                mocap = int(self._model.body(object_id).mocapid[0])
                self._data.mocap_pos[mocap], self._data.mocap_quat[mocap] = p, q
            else:
                address = self._joint_address(object_id)
                self._data.qpos[address : address + 7] = np.concatenate([p, q])
        mujoco.mj_forward(self._model, self._data)
        self._pending.clear()
        self.command(joints_rad, MAX_WIDTH_M)
        self._data.ctrl[:] = self._pending[0]
        mujoco.mj_forward(self._model, self._data)

    def command(self, joints_rad: Float[np.ndarray, "6"], width_m: float) -> None:
        """Send targets to the servos; they act after the cell's latency."""
        if self._play_rad.any():  # a link follows where its motor reaches the end of the play
            last_rad = self._pending[-1][:-1] if self._pending else joints_rad
            half_rad = self._play_rad / 2
            link_rad = np.clip(last_rad, joints_rad - half_rad, joints_rad + half_rad)
            self.slack_rad, joints_rad = joints_rad - link_rad, link_rad
        target = np.concatenate([joints_rad, [width_m / 2]])
        self._pending.append(target)

    def step(self) -> None:
        """Advance by ``step_s``."""
        if len(self._pending) == self._pending.maxlen:
            self._data.ctrl[:] = self._pending[0]
        if self._pending:
            # Without a new command the last one is repeated, so that delays run out.
            self._pending.append(self._pending[-1])
        mujoco.mj_step(self._model, self._data)

    @property
    def joints_rad(self) -> Float[np.ndarray, "6"]:
        """True arm angles."""
        return np.array(self._data.qpos[self._arm])

    @property
    def joint_speeds_rad_s(self) -> Float[np.ndarray, "6"]:
        """True arm speeds."""
        return np.array(self._data.qvel[self._arm_dofs])

    @property
    def joint_efforts_Nm(self) -> Float[np.ndarray, "6"]:
        """Torques of the arm's motors, with those that carry its own weight."""
        servos = self._data.actuator_force[: len(ARM_JOINTS)]
        return np.array(servos + self._data.qfrc_gravcomp[self._arm_dofs])

    def arm_force_N(self) -> Float[np.ndarray, "3"]:
        """Force of all rigid bodies on arm and fingers together; what a grasp presses cancels."""
        mujoco.mj_rnePostConstraint(self._model, self._data)
        return np.asarray(self._data.cfrc_ext[self._link_bodies, 3:].sum(axis=0))

    @property
    def width_m(self) -> float:
        """Distance between the finger pads."""
        return float(np.sum(self._data.qpos[self._fingers]))

    def T_base_body(self, name: str) -> Float[np.ndarray, "4 4"]:
        """True pose of a link or object."""
        body = self._data.body(name)
        return se3.transform_from(np.array(body.xquat), np.array(body.xpos))

    def Ts_base_link(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """True poses of all links that have a shape."""
        return {name: self.T_base_body(name) for name in self._links}

    def Ts_base_object(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """True poses of all objects."""
        return {
            object_id: se3.align_rigid(self._soft[object_id].rest_nodes_m, self.nodes_m(object_id))
            if object_id in self._soft
            else self.T_base_body(object_id)
            for object_id in self.task.objects
        }

    def nodes_m(self, object_id: str) -> Float[np.ndarray, "8 3"]:
        """Where the nodes of a soft object are."""
        return np.array(self._data.xpos[self._soft[object_id].body_ids])

    def lattice_m(self, object_id: str) -> Float[np.ndarray, "num_points 3"]:
        """Where the points inside and on a soft object are."""
        return np.asarray(self._soft[object_id].lattice_weights @ self.nodes_m(object_id))

    def skins_m(self) -> dict[str, Float[np.ndarray, "num_vertices 3"]]:
        """Where the vertices of the soft objects' meshes are, as they are deformed."""
        return {key: body.skin_weights @ self.nodes_m(key) for key, body in self._soft.items()}

    def extents_m(
        self, object_id: str, T_base_object: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "3"]:
        """Outer extents of a soft object's deformed surface along the axes of its pose."""
        surface_m = self._soft[object_id].skin_weights @ self.nodes_m(object_id)
        local_m = (surface_m - T_base_object[:3, 3]) @ T_base_object[:3, :3]
        return np.asarray(np.ptp(local_m, axis=0))

    def finger_contact(self) -> dict[str, bool]:
        """Per object: whether a finger touches it now."""
        touched = dict.fromkeys(self.task.objects, False)
        contacts = self._data.contact
        for pair, flexes in zip(contacts.geom.tolist(), contacts.flex.tolist(), strict=True):
            for finger, geom, flex in ((*pair, flexes[1]), (*pair[::-1], flexes[0])):
                name = self._objects.get(geom) or self._flexes.get(flex)
                if name and finger in self._finger_geoms:
                    touched[name] = True
        return touched
