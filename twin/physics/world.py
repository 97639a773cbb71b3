"""One simulated cell: the robot and boxes in PyBullet, soft bodies beside them on one clock.

Measured choices (design page on physics): ``deterministicOverlappingPairs`` always on, 240 Hz with
75 solver iterations and anchored friction (slip p90 0.5 mm, 24 of 24 grasps held), a gear of ratio
-1 between the fingers, whose axes point outward (+1 lets them shear and the grasp fails). No
spinning friction: a patch is its corner points, which resist turning more than a patch does. The
same bits on every run.
"""

from collections.abc import Callable, Sequence
from math import cos, hypot
from operator import methodcaller
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.leaves import load_leaf
from twin.physics.arm import Arm, Hulls, Joints, PhysicsError, Press
from twin.physics.config import PhysicsConfig, Unseen
from twin.physics.engine import Client, give_client_back, open_client, pybullet
from twin.physics.unseen import EVEN, box_inertia, solids

# Friction that holds where it held: PyBullet's friction anchors, with fresh contact normals.
# Without anchors friction acts against velocities only, and what the solver leaves of them adds
# up to a creep that takes hundreds of iterations to keep small. With an anchor a contact point
# stays where it took hold while its force is within Coulomb's cone, and is let go when it is not.
# The engine then keeps all of the point, also its normal in the world, which goes wrong when what
# is held turns. So a body that has turned by a little takes hold anew.
# docs/decisions/0017-contact-physics.md.

TURN_RAD = 0.03
"""A body that has turned by this much takes hold anew."""
EVERY_STEPS = 4
"""How often bodies are asked; the fastest joint turns by 0.05 rad meanwhile."""
_DYNAMIC, _ALL = 1, -1
"""PyBullet's collision group and mask of bodies that move."""


class FrictionAnchors:
    """The anchors of the rigid bodies that move freely in one PyBullet client."""

    def __init__(self, client: Client) -> None:
        """Start without bodies."""
        self.client = client
        self._held: dict[int, tuple[float, ...]] = {}
        self._steps = 0

    def add(self, body: int) -> None:
        """Let a body's contacts hold from now on."""
        self._held[body] = self._orientation(body)
        self.client.changeDynamics(body, -1, frictionAnchor=1)

    def refresh(self) -> bool:
        """Let bodies that have turned take hold anew in the next step; whether any does.

        Call once per step.
        """
        self._steps += 1
        if self._steps % EVERY_STEPS:
            return False
        anew = False
        for body, (x0, y0, z0, w0) in self._held.items():
            x, y, z, w = now = self._orientation(body)
            if abs(x * x0 + y * y0 + z * z0 + w * w0) < cos(TURN_RAD / 2):
                self._held[body] = now
                # Setting the group that it has already is how PyBullet drops contact points.
                self.client.setCollisionFilterGroupMask(body, -1, _DYNAMIC, _ALL)
                anew = True
        return anew

    def _orientation(self, body: int) -> tuple[float, ...]:
        _, q = self.client.getBasePositionAndOrientation(body)
        return tuple(q)


Box = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
"""Centre and extents in the owner's frame [m]."""
TABLE_M = (4.0, 4.0, 0.4)
_World = TypeVar("_World")


class Bodies:
    """An empty world of PyBullet. A context manager: its client goes away at the end."""

    def __init__(self, config: PhysicsConfig) -> None:
        """Take a client."""
        self.config = config
        self.client = open_client(config)
        self._anchors = FrictionAnchors(self.client)

    def _box(
        self, size_m: Float[np.ndarray, "3"], mass_kg: float, T: Float[np.ndarray, "4 4"]
    ) -> int:
        shape = self.client.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=(size_m / 2).tolist()
        )
        return self._body(shape, mass_kg, T)

    def _body(self, shape: int, mass_kg: float, T: Float[np.ndarray, "4 4"]) -> int:
        q, p = se3.split(T)
        return int(
            self.client.createMultiBody(
                baseMass=mass_kg,
                baseCollisionShapeIndex=shape,
                basePosition=p.tolist(),
                baseOrientation=[q[1], q[2], q[3], q[0]],
                # What never moves needs no articulated body: the same bits for less.
                useMaximalCoordinates=mass_kg == 0.0,
            )
        )

    def _undamp(self, body: int) -> None:
        """Nothing slows down in the air; the engine would take 3 s for 83 % of a spin's energy."""
        self.client.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)

    def _set_friction(self, body: int, friction: float) -> None:
        self.client.changeDynamics(body, -1, lateralFriction=friction)

    def close(self) -> None:
        """Give the client back; a second call does nothing."""
        if self.client.number >= 0:
            give_client_back(self.client)
            self.client = Client(-1)

    def __enter__(self: _World) -> _World:
        """Use as a context manager."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


class World(Bodies):
    """One simulated cell."""

    def __init__(self, urdf: str, mesh_hulls_m: Hulls, config: PhysicsConfig) -> None:
        """Load the robot with its base at the origin."""
        super().__init__(config)
        self.free_ids: dict[str, int] = {}
        self._centres_m: dict[str, Float[np.ndarray, 3]] = {}
        try:
            self.robot = Arm(self.client, urdf, mesh_hulls_m, config)
        except PhysicsError:
            self.close()
            raise
        self._undamp(self.robot.id)
        self._press = Press(self.robot)
        self._description = (urdf, mesh_hulls_m)
        self._soft: Any = None  # what the leaf ``soft`` begins, when asked
        self._solids: list[Callable[[Any], None]] = []

    def add_static(self, boxes: Sequence[Box], T_base_owner: Float[np.ndarray, "4 4"]) -> list[int]:
        """Add solid boxes that never move, one body each; returns the body ids."""
        ids = []
        for centre, extents in boxes:
            T_owner_box = np.eye(4)
            T_owner_box[:3, 3] = centre
            body = self._box(extents, 0.0, T_base_owner @ T_owner_box)
            self._set_friction(body, self.config.surface_friction)
            self._meet(methodcaller("add_static", extents, T_base_owner @ T_owner_box))
            ids.append(body)
        return ids

    def add_table(self, height_m: float) -> int:
        """Add the table: a slab around the robot's base, whose top is at the height over it."""
        centre = np.array([0.0, 0.0, height_m - TABLE_M[2] / 2])
        body = self.add_static([(centre, np.array(TABLE_M))], np.eye(4))[0]
        # The robot stands on the table: its base touches it by construction.
        for link in (-1, *self.robot.base_links):
            self.client.setCollisionFilterPair(self.robot.id, body, link, -1, 0)
        return body

    def add_free(
        self,
        object_id: str,
        size_m: Float[np.ndarray, "3"],
        mass_kg: float,
        T_base_object: Float[np.ndarray, "4 4"],
        unseen: Unseen = EVEN,
    ) -> None:
        """Add a solid box that moves; its mass is even, but for where its centre is said to be."""
        if unseen == EVEN:
            body = self._box(size_m, mass_kg, T_base_object)
        else:
            body = self._uneven_box(size_m, mass_kg, T_base_object, unseen)
            self._centres_m[object_id] = np.array(unseen.centre_of_mass_m)
        self._set_friction(body, self.config.object_friction)
        self._undamp(body)
        self._anchors.add(body)
        self._meet(methodcaller("add_free", body, size_m, mass_kg, T_base_object, unseen))
        self.free_ids[object_id] = body

    def _uneven_box(
        self,
        size_m: Float[np.ndarray, "3"],
        mass_kg: float,
        T_base_object: Float[np.ndarray, "4 4"],
        unseen: Unseen,
    ) -> int:
        """A box whose frame is its centre of mass, as the engine wants it."""
        boxes, centre = solids(unseen, size_m), np.array(unseen.centre_of_mass_m)
        T_base_mass = T_base_object.copy()
        T_base_mass[:3, 3] = se3.apply(T_base_object, centre)
        shape = self.client.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(boxes),
            halfExtents=[(extents / 2).tolist() for extents in boxes],
            collisionFramePositions=[(-centre).tolist()] * len(boxes),
        )
        body = self._body(shape, mass_kg, T_base_mass)
        inertia = list(box_inertia(size_m, mass_kg))
        self.client.changeDynamics(body, -1, localInertiaDiagonal=inertia)
        return body

    def reset_robot(self, joints_rad: Joints, width_m: float, rad_s: Joints | None = None) -> None:
        """Put the robot into a posture, at rest or at a speed, without simulating."""
        self.robot.reset(joints_rad, width_m, rad_s)
        if self._soft is not None:
            self._soft.place_links()

    def step(self) -> None:
        """Advance rigid and soft bodies by one fixed step."""
        soft = self._soft
        if soft is not None:
            soft.push_rigid()
        anew = self._anchors.refresh()
        if soft is None or not soft.names:  # soft bodies slow the fingers down themselves
            self._press.update(anew=anew)
        self.client.stepSimulation()
        if soft is not None:
            soft.step()

    def object_pose(self, object_id: str) -> tuple[float, ...]:
        """Position [m] and quaternion wxyz of a rigid object that moves, seven numbers."""
        p, (x, y, z, w) = self.client.getBasePositionAndOrientation(self._free(object_id))
        centre = self._centres_m.get(object_id)
        if centre is not None:
            p = (
                np.array(p) - se3.rotation_from_quaternion(np.array([w, x, y, z])) @ centre
            ).tolist()
        return (*p, w, x, y, z)

    def T_base_object(self, object_id: str) -> Float[np.ndarray, "4 4"]:
        """Pose of an object that moves; of a soft one, the rigid motion nearest to its nodes."""
        if (soft := self._softly(object_id)) is not None:
            return np.array(soft.T_base_object(object_id))
        pose = np.array(self.object_pose(object_id))
        return se3.transform_from(pose[3:], pose[:3])

    def finger_touches(self, object_id: str) -> bool:
        """Whether a finger is in contact with an object that moves."""
        if (soft := self._softly(object_id)) is not None:
            return bool(soft.finger_touches(object_id))
        body = self._free(object_id)
        return any(
            point[8] <= 0.0
            for link in self.robot.finger_links
            for point in self.client.getContactPoints(self.robot.id, body, linkIndexA=link)
        )

    def arm_force_N(self) -> float:
        """Size of the force that rigid bodies exert on the arm in all; a grasp's cancel out."""
        x = y = z = 0.0  # numpy is slower for three numbers
        for point in self.client.getContactPoints(self.robot.id):
            if point[1] != point[2]:  # not the arm against itself
                for size, axis in ((9, 7), (10, 11), (12, 13)):
                    newton, (along_x, along_y, along_z) = point[size], point[axis]
                    x, y, z = x + newton * along_x, y + newton * along_y, z + newton * along_z
        return hypot(x, y, z)

    def soft_bodies(self) -> Any:
        """What is soft in this world; asking the first time begins it."""
        if self._soft is None:
            begin = load_leaf("soft", "world")
            soft = begin(self.client, self.robot, *self._description, self.config)
            for add in self._solids:
                add(soft)
            self._soft, self._solids = soft, []
        return self._soft

    def _meet(self, add: Callable[[Any], None]) -> None:
        """Let soft bodies meet a solid, at once or when they begin."""
        if self._soft is None:
            self._solids.append(add)
        else:
            add(self._soft)

    def _softly(self, object_id: str) -> Any:
        """The soft bodies, where an object is one of them."""
        has = self._soft is not None and object_id in self._soft.names
        return self._soft if has else None

    def _free(self, object_id: str) -> int:
        if object_id not in self.free_ids:
            soft = () if self._soft is None else self._soft.names
            known = ", ".join([*self.free_ids, *soft]) or "none"
            raise PhysicsError(f"no object {object_id!r} moves in this world. There are: {known}.")
        return self.free_ids[object_id]
