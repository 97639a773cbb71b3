"""A PyBullet world of one robot, static boxes and free boxes; the same bits on every run.

Measured choices (design page on physics): ``deterministicOverlappingPairs`` always on, 240 Hz with
200 solver iterations (slip p90 1.7 mm, 24 of 24 grasps held), a gear of ratio -1 between the
fingers, whose axes point outward (+1 lets them shear and the grasp fails).
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.robot import (
    ARM_JOINTS,
    BASE_FRAME,
    FINGER_JOINTS,
    FINGER_LINKS,
    MAX_WIDTH_M,
    TCP_FRAME,
)
from twin.errors import TwinError
from twin.physics.config import PhysicsConfig
from twin.physics.description import Hulls, write_description
from twin.physics.engine import pybullet


class PhysicsError(TwinError):
    """The physics engine refused or lost something."""


Box = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
"""Centre and extents in the owner's frame [m]."""


class World:
    """One simulated cell. A context manager: its client and its files go away at the end."""

    def __init__(self, urdf: str, mesh_hulls_m: Hulls, config: PhysicsConfig) -> None:
        """Load the robot with its base at the origin.

        Args:
            urdf: Description without package URIs.
            mesh_hulls_m: Per link, hulls that replace its collision meshes [m].
            config: Rates, frictions and forces.

        Raises:
            PhysicsError: When PyBullet does not load the description or joints are missing.
        """
        self.config = config
        self._client = pybullet.connect(pybullet.DIRECT)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=1.0 / config.rate_hz,
            numSolverIterations=config.solver_iterations,
            numSubSteps=0,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            physicsClientId=self._client,
        )
        pybullet.setGravity(0, 0, -config.gravity_m_s2, physicsClientId=self._client)
        self.free_ids: dict[str, int] = {}
        self._robot = self._load_robot(urdf, mesh_hulls_m)
        self._index_joints()
        self._couple_fingers()

    def _load_robot(self, urdf: str, mesh_hulls_m: Hulls) -> int:
        with tempfile.TemporaryDirectory(prefix="robot-gst-physics-") as folder:
            path = write_description(urdf, mesh_hulls_m, Path(folder))
            try:
                return int(
                    pybullet.loadURDF(
                        str(path),
                        useFixedBase=True,
                        flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                        physicsClientId=self._client,
                    )
                )
            except pybullet.error as error:
                self.close()
                message = (
                    f"PyBullet does not load the robot description ({error}). "
                    "Check its links and collision meshes."
                )
                raise PhysicsError(message) from error

    def _index_joints(self) -> None:
        self._joints: dict[str, int] = {}
        self._links: dict[str, int] = {}
        self._efforts: dict[str, float] = {}
        client = self._client
        for index in range(pybullet.getNumJoints(self._robot, physicsClientId=client)):
            item = pybullet.getJointInfo(self._robot, index, physicsClientId=client)
            self._joints[item[1].decode()] = index
            self._links[item[12].decode()] = index
            self._efforts[item[1].decode()] = item[10]
        missing = [name for name in (*ARM_JOINTS, *FINGER_JOINTS) if name not in self._joints] + [
            name for name in (TCP_FRAME,) if name not in self._links
        ]
        if missing:
            self.close()
            message = (
                f"the robot description lacks {', '.join(missing)}; it has the joints "
                f"{', '.join(self._joints)}. Physics needs the arm and two prismatic fingers."
            )
            raise PhysicsError(message)
        self._arm = [self._joints[name] for name in ARM_JOINTS]
        self._fingers = [self._joints[name] for name in FINGER_JOINTS]
        self._finger_links = [self._links[name] for name in FINGER_LINKS]
        self._arm_forces = [self._efforts[name] for name in ARM_JOINTS]

    def _couple_fingers(self) -> None:
        for link in self._finger_links:
            pybullet.changeDynamics(
                self._robot,
                link,
                lateralFriction=self.config.finger_friction,
                spinningFriction=self.config.spinning_friction_m,
                physicsClientId=self._client,
            )
        gear = pybullet.createConstraint(
            self._robot,
            self._finger_links[0],
            self._robot,
            self._finger_links[1],
            pybullet.JOINT_GEAR,
            [0, 1, 0],
            [0, 0, 0],
            [0, 0, 0],
            physicsClientId=self._client,
        )
        pybullet.changeConstraint(
            gear,
            gearRatio=-1,
            erp=0.2,
            maxForce=10 * self.config.grip_force_N,
            physicsClientId=self._client,
        )

    def add_static(self, boxes: Sequence[Box], T_base_owner: Float[np.ndarray, "4 4"]) -> list[int]:
        """Add solid boxes that never move, one body each; returns the body ids."""
        ids = []
        for centre, extents in boxes:
            T_owner_box = np.eye(4)
            T_owner_box[:3, 3] = centre
            body = self._box(extents, 0.0, T_base_owner @ T_owner_box)
            self._set_friction(body, self.config.surface_friction)
            ids.append(body)
        return ids

    def add_table(self, height_m: float, size_m: float = 4.0, thickness_m: float = 0.4) -> int:
        """Add the table: a slab whose top is at the height."""
        centre = np.array([0.0, 0.0, height_m - thickness_m / 2])
        extents = np.array([size_m, size_m, thickness_m])
        body = self.add_static([(centre, extents)], np.eye(4))[0]
        # The robot stands on the table: its base touches it by construction.
        pybullet.setCollisionFilterPair(self._robot, body, -1, -1, 0, physicsClientId=self._client)
        if BASE_FRAME in self._links:
            pybullet.setCollisionFilterPair(
                self._robot, body, self._links[BASE_FRAME], -1, 0, physicsClientId=self._client
            )
        return body

    def add_free(
        self,
        object_id: str,
        size_m: Float[np.ndarray, "3"],
        mass_kg: float,
        T_base_object: Float[np.ndarray, "4 4"],
    ) -> None:
        """Add a solid box that moves."""
        body = self._box(size_m, mass_kg, T_base_object)
        self._set_friction(body, self.config.object_friction)
        self.free_ids[object_id] = body

    def _box(
        self, size_m: Float[np.ndarray, "3"], mass_kg: float, T: Float[np.ndarray, "4 4"]
    ) -> int:
        q, p = se3.split(T)
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=(size_m / 2).tolist(), physicsClientId=self._client
        )
        return int(
            pybullet.createMultiBody(
                baseMass=mass_kg,
                baseCollisionShapeIndex=shape,
                basePosition=p.tolist(),
                baseOrientation=[q[1], q[2], q[3], q[0]],
                physicsClientId=self._client,
            )
        )

    def _set_friction(self, body: int, friction: float) -> None:
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=friction,
            spinningFriction=self.config.spinning_friction_m,
            physicsClientId=self._client,
        )

    def reset_robot(self, joints_rad: Float[np.ndarray, " num_joints"], width_m: float) -> None:
        """Put the robot into a posture at rest, without simulating."""
        for index, value in zip(self._arm, joints_rad, strict=True):
            pybullet.resetJointState(
                self._robot, index, float(value), 0.0, physicsClientId=self._client
            )
        for index in self._fingers:
            pybullet.resetJointState(
                self._robot, index, float(width_m) / 2, 0.0, physicsClientId=self._client
            )

    def command(
        self,
        joints_rad: Float[np.ndarray, " num_joints"],
        velocity_rad_s: Float[np.ndarray, " num_joints"],
        width_m: float,
    ) -> None:
        """Set the position targets that the motors follow from the next step on."""
        pybullet.setJointMotorControlArray(
            self._robot,
            self._arm,
            pybullet.POSITION_CONTROL,
            targetPositions=joints_rad.tolist(),
            targetVelocities=velocity_rad_s.tolist(),
            forces=self._arm_forces,
            physicsClientId=self._client,
        )
        half = min(max(width_m, 0.0), MAX_WIDTH_M) / 2
        for index in self._fingers:
            pybullet.setJointMotorControl2(
                self._robot,
                index,
                pybullet.POSITION_CONTROL,
                targetPosition=half,
                force=self.config.grip_force_N,
                maxVelocity=self.config.finger_speed_m_s,
                physicsClientId=self._client,
            )

    def step(self) -> None:
        """Advance by one fixed step."""
        pybullet.stepSimulation(physicsClientId=self._client)

    def joints_rad(self) -> Float[np.ndarray, " num_joints"]:
        """Where the arm is."""
        states = pybullet.getJointStates(self._robot, self._arm, physicsClientId=self._client)
        return np.array([state[0] for state in states])

    def width_m(self) -> float:
        """Distance between the finger pads."""
        states = pybullet.getJointStates(self._robot, self._fingers, physicsClientId=self._client)
        return float(sum(state[0] for state in states))

    def T_base_link(self, link: str) -> Float[np.ndarray, "4 4"]:
        """Pose of a link's frame."""
        state = pybullet.getLinkState(
            self._robot,
            self._links[link],
            computeForwardKinematics=1,
            physicsClientId=self._client,
        )
        x, y, z, w = state[5]
        return se3.transform_from(np.array([w, x, y, z]), np.array(state[4]))

    def object_pose(self, object_id: str) -> tuple[float, ...]:
        """Position [m] and quaternion wxyz of a free object, seven numbers."""
        p, (x, y, z, w) = pybullet.getBasePositionAndOrientation(
            self.free_ids[object_id], physicsClientId=self._client
        )
        return (*p, w, x, y, z)

    def T_base_object(self, object_id: str) -> Float[np.ndarray, "4 4"]:
        """Pose of a free object."""
        pose = np.array(self.object_pose(object_id))
        return se3.transform_from(pose[3:], pose[:3])

    def finger_touches(self, object_id: str) -> bool:
        """Whether a finger is in contact with a free object."""
        return any(
            point[8] <= 0.0
            for link in self._finger_links
            for point in pybullet.getContactPoints(
                self._robot,
                self.free_ids[object_id],
                link,
                -1,
                physicsClientId=self._client,
            )
        )

    @property
    def client(self) -> int:
        """PyBullet's number of this world."""
        return self._client

    @property
    def robot_id(self) -> int:
        """PyBullet's number of the robot."""
        return self._robot

    def link_id(self, link: str) -> int:
        """PyBullet's number of a link of the robot."""
        return self._links[link]

    def close(self) -> None:
        """Give the client back; a second call does nothing."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def __enter__(self) -> "World":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close."""
        self.close()
