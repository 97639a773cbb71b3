"""The MuJoCo model of the laboratory: robot, gripper, table, task objects."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.sources.standin.cell_file import Clutter
from bridge.sources.standin.hidden import HiddenParameters
from bridge.sources.standin.links import LinkModel, LinkShape, robot_links
from bridge.sources.standin.soft import soft_model_xml
from bridge.task.meshes.basket import BoxPart, basket_parts
from bridge.task.robot import (
    ARM_JOINTS,
    BASE_FRAME,
    FINGER_JOINTS,
    FINGER_LINKS,
    MAX_WIDTH_M,
    TCP_FRAME,
)
from bridge.task.task_file import BASKET, ObjectModel, Task

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


def step_s_of(task: Task) -> float:
    """Return the length of one physics step of a task [s]."""
    return SOFT_STEP_S if task.soft_objects else STEP_S


def build_model(task: Task, hidden: HiddenParameters, clutter: Sequence[Clutter] = ()) -> Any:
    """Compile the laboratory with its true parameters into an ``mjModel``."""
    if task.soft_objects:
        spec = mujoco.MjSpec.from_string(soft_model_xml(task, hidden))
        # The only integrator that takes the elasticity of flexes.
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    else:
        spec = mujoco.MjSpec()
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.timestep = step_s_of(task)
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0  # friction held stiffly: no creep of a grasped object
    spec.compiler.degree = False
    _add_robot(spec, hidden)
    _add_table(spec)
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
    for link in robot_links():
        q, p = se3.split(link.T_parent_link)
        body = bodies[link.parent].add_body(name=link.name, pos=p, quat=q, gravcomp=1.0)
        bodies[link.name] = body
        _set_inertia(body, link)
        _add_joint(body, link)
        for index, shape in enumerate(link.shapes):
            _add_shape(spec, body, shape, name=f"{link.name}_{index}", hidden=hidden)
        if link.name == TCP_FRAME:
            body.add_site(name=TCP_FRAME)


def _set_inertia(body: Any, link: LinkModel) -> None:
    body.explicitinertial = True
    p = link.T_link_inertial[:3, 3]
    if link.mass_kg > 0:
        R = link.T_link_inertial[:3, :3]
        xx, yy, zz, xy, xz, yz = link.inertia
        tensor = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
        body.mass, body.ipos = link.mass_kg, p
        body.fullinertia = [
            tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        ]
    else:
        body.mass, body.inertia = 1e-3, [1e-6] * 3


def _add_joint(body: Any, link: LinkModel) -> None:
    if link.joint_type == "revolute":
        body.add_joint(
            name=link.joint,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=link.axis,
            range=link.limits,
            armature=ARM_ARMATURE,
        )
    elif link.joint_type == "prismatic":
        body.add_joint(
            name=link.joint,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=link.axis,
            range=link.limits,
            armature=FINGER_ARMATURE,
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
    if shape.mesh is not None:
        spec.add_mesh(name=name, file=shape.mesh)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **settings)
    elif shape.box_m is not None:
        half = [extent / 2 for extent in shape.box_m]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, **settings)


def _add_table(spec: Any) -> None:
    x, y, z = TABLE_SIZE_M
    body = spec.worldbody.add_body(name="table", pos=[*TABLE_CENTRE_M, -z / 2])
    body.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[x / 2, y / 2, z / 2],
        **_WORLD_BITS,
    )


def _add_object(spec: Any, model: ObjectModel, hidden: HiddenParameters) -> None:
    body = spec.worldbody.add_body(name=model.id, mocap=model.fixed, pos=[0, 0, 0.5])
    parts = solid_parts(model)
    volume = sum(float(np.prod(part.size_m)) for part in parts)
    for index, part in enumerate(parts):
        mass = model.mass_kg * hidden.mass_scale * float(np.prod(part.size_m)) / volume
        body.add_geom(
            name=f"{model.id}_{index}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=part.centre_m,
            quat=part.q_wxyz,
            size=_half(part.size_m),
            mass=mass,
            priority=1,
            condim=4,
            friction=[hidden.object_friction, 0.005, 0.0001],
            **_WORLD_BITS,
        )
    if not model.fixed:
        body.add_freejoint(name=model.id)


def solid_parts(model: ObjectModel) -> list[BoxPart]:
    """The boxes a rigid object collides with."""
    if model.mesh == BASKET:
        return basket_parts(model.inner_m, model.wall_m)
    straight = np.array([1.0, 0.0, 0.0, 0.0])
    return [
        BoxPart(centre_m=centre, size_m=size, q_wxyz=straight) for centre, size in model.panels()
    ]


def _add_clutter(spec: Any, item: Clutter, index: int) -> None:
    """A box around the thing; nothing is meant to touch it."""
    q, p = se3.split(item.T_base_clutter)
    spec.worldbody.add_geom(
        name=f"clutter_{index}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=p,
        quat=q,
        size=_half(np.array(item.size_m)),
        **_WORLD_BITS,
    )


def _half(size: Float[np.ndarray, "3"]) -> list[float]:
    return [float(extent) / 2 for extent in size]


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
