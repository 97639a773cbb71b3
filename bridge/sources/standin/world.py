"""The laboratory in motion: MuJoCo stepped, commanded and read in our own terms."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.sources.standin.cell_file import Clutter
from bridge.sources.standin.hidden import HiddenParameters
from bridge.sources.standin.links import robot_links
from bridge.sources.standin.soft import SoftBody, soft_body
from bridge.sources.standin.world_model import build_model, solid_parts, step_s_of
from bridge.task.robot import ARM_JOINTS, FINGER_JOINTS, FINGER_LINKS, MAX_WIDTH_M
from bridge.task.task_file import Task


class World:
    """True state of the cell. Joint angles here are true ones, not encoder readings."""

    def __init__(
        self, task: Task, hidden: HiddenParameters, clutter: Sequence[Clutter] = ()
    ) -> None:
        """Build the model and stand still with the gripper open."""
        self.task = task
        self.step_s = step_s_of(task)
        self._hidden = hidden
        self._model: Any = build_model(task, hidden, clutter)
        self._data: Any = mujoco.MjData(self._model)
        self._arm = [self._joint_address(name) for name in ARM_JOINTS]
        self._fingers = [self._joint_address(name) for name in FINGER_JOINTS]
        self._arm_dofs = [int(self._model.joint(name).dofadr[0]) for name in ARM_JOINTS]
        self._links = [link.name for link in robot_links() if link.shapes]
        self._finger_geoms = {int(self._model.geom(f"{name}_0").id) for name in FINGER_LINKS}
        self._object_geoms = {
            object_id: {
                int(self._model.geom(f"{object_id}_{index}").id)
                for index in range(len(solid_parts(model)))
            }
            for object_id, model in task.objects.items()
            if model.soft is None
        }
        self._soft: dict[str, SoftBody] = {
            object_id: soft_body(task.objects[object_id], self._model)
            for object_id in task.soft_objects
        }
        flex_type = mujoco.mjtObj.mjOBJ_FLEX
        self._flexes = {mujoco.mj_name2id(self._model, flex_type, key): key for key in self._soft}
        delay = max(round(hidden.latency_s / self.step_s), 0)
        self._pending: deque[np.ndarray] = deque(maxlen=delay + 1)

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
        self._pending.clear()
        self.place(Ts_base_object)
        self.command(joints_rad, MAX_WIDTH_M)
        self._data.ctrl[:] = self._pending[0]
        mujoco.mj_forward(self._model, self._data)

    def place(self, Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]]) -> None:
        """Move objects by hand; the arm stays as it is."""
        for object_id, T in Ts_base_object.items():
            q, p = se3.split(T)
            if object_id in self._soft:
                body = self._soft[object_id]
                self._data.qpos[body.addresses] = body.qpos_at(T)
                self._data.qvel[body.dofs] = 0.0
            elif self.task.objects[object_id].fixed:
                mocap = int(self._model.body(object_id).mocapid[0])
                self._data.mocap_pos[mocap], self._data.mocap_quat[mocap] = p, q
            else:
                address = self._joint_address(object_id)
                self._data.qpos[address : address + 7] = np.concatenate([p, q])
                dof = int(self._model.joint(object_id).dofadr[0])
                self._data.qvel[dof : dof + 6] = 0.0
        mujoco.mj_forward(self._model, self._data)

    def command(self, joints_rad: Float[np.ndarray, "6"], width_m: float) -> None:
        """Send targets to the servos; they act after the cell's latency."""
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
        """Torques of the arm's servos."""
        return np.array(self._data.actuator_force[: len(ARM_JOINTS)])

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
            object_id: self._soft[object_id].pose_of(self.nodes_m(object_id))
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
        """Outer extents of a soft object along the axes of its pose."""
        return self._soft[object_id].extents_m(self.nodes_m(object_id), T_base_object)

    def finger_contact(self) -> dict[str, bool]:
        """Per object: whether a finger touches it now."""
        touched = dict.fromkeys(self.task.objects, False)
        contacts = self._data.contact
        for pair, flexes in zip(contacts.geom, contacts.flex, strict=True):
            for finger, flex in ((pair[0], flexes[1]), (pair[1], flexes[0])):
                if finger in self._finger_geoms and flex in self._flexes:
                    touched[self._flexes[int(flex)]] = True
        for first, second in contacts.geom:
            for object_id, geoms in self._object_geoms.items():
                if (first in geoms and second in self._finger_geoms) or (
                    second in geoms and first in self._finger_geoms
                ):
                    touched[object_id] = True
        return touched
