"""Soft bodies beside PyBullet, on its clock: what drives them, and what they do to rigid bodies.

Each step PyBullet moves first; then the soft bodies take their substeps while links and boxes go
from their old poses to the new ones. What they push back with reaches PyBullet with its next step:
on boxes as velocity, on the arm as a force, on the fingers as a slower drive.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.physics.arm import Arm, Hulls, LinkPose
from twin.physics.config import PhysicsConfig, Unseen
from twin.physics.engine import Client
from twin.physics.soft import Skin, SoftHealth, SoftModel, bind_points, health_of, rigid_fit
from twin.physics.soft_solver import ConvexPiece, SoftSolver, add_body, box_piece, link_pieces
from twin.physics.unseen import EVEN, box_inertia

Three = tuple[float, float, float]
SUBSTEPS = 10
"""Substeps of soft bodies within each physics step: 2400 a second at 240 steps."""


# Called in every physics step, so in plain numbers: arrays of three cost more than the sums.


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: tuple[float, ...], b: tuple[float, ...]) -> Three:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _sum(a: tuple[float, ...], b: tuple[float, ...]) -> Three:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _rotated(q_xyzw: tuple[float, ...], v: tuple[float, ...]) -> Three:
    """Turn a vector: v + 2 w (u x v) + 2 u x (u x v) for the quaternion (u, w)."""
    u, w = q_xyzw[:3], q_xyzw[3]
    once = _cross(u, v)
    twice = _cross(u, once)
    return (
        v[0] + 2 * (w * once[0] + twice[0]),
        v[1] + 2 * (w * once[1] + twice[1]),
        v[2] + 2 * (w * once[2] + twice[2]),
    )


@dataclass(frozen=True, kw_only=True)
class _SoftBody:
    index: int
    model: SoftModel
    skin: Skin | None
    rest_extents_m: Float[np.ndarray, "3"]


class SoftWorld:
    """The soft part of a world. Costs nothing until a soft body is added."""

    def __init__(
        self, client: Client, arm: Arm, urdf: str, mesh_hulls_m: Hulls, config: PhysicsConfig
    ) -> None:
        """Remember what soft bodies will meet."""
        self.names: dict[str, _SoftBody] = {}
        self._client, self._arm, self._config = client, arm, config
        self._description = (urdf, mesh_hulls_m)
        self._period_s = 1.0 / config.rate_hz
        self._waiting: list[tuple[Any, ...]] = []
        """Pieces as the solver will get them."""
        self._free: dict[int, int] = {}
        self._solver: SoftSolver | None = None
        self._num_pieces = 0
        self._link_pieces: dict[str, list[int]] = {}
        self._link_ids: list[int] = []
        self._link_of: dict[int, str] = {}
        self._states: dict[str, LinkPose] = {}
        self._yields = False
        self._pushed: list[int] = []
        self._fits: dict[str, Float[np.ndarray, "4 4"]] = {}
        self._pushes: Float[np.ndarray, "num_pieces 15"] = np.zeros((0, 15))

    def add_static(
        self, size_m: Float[np.ndarray, "3"], T_base_box: Float[np.ndarray, "4 4"]
    ) -> None:
        """Add a box that never moves."""
        pose, friction = _pose(T_base_box), self._config.surface_friction
        self._add(box_piece(size_m, np.eye(4)), pose, friction)

    def add_free(
        self,
        body: int,
        size_m: Float[np.ndarray, "3"],
        mass_kg: float,
        T_base_box: Float[np.ndarray, "4 4"],
        unseen: Unseen = EVEN,
    ) -> None:
        """Add a box that PyBullet moves; soft bodies meet it with full edges."""
        T_base_body, T_body_box = T_base_box.copy(), np.eye(4)
        T_base_body[:3, 3] = se3.apply(T_base_box, np.array(unseen.centre_of_mass_m))
        T_body_box[:3, 3] = -np.array(unseen.centre_of_mass_m)
        self._free[body] = self._add(
            box_piece(size_m, T_body_box),
            _pose(T_base_body),
            self._config.object_friction,
            mass_kg,
            box_inertia(size_m, mass_kg),
        )

    def _add(
        self,
        piece: ConvexPiece,
        pose: tuple[float, ...],
        friction: float,
        mass_kg: float = 0.0,
        inertia: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> int:
        """Returns the number that the solver gives, or will give, to the piece."""
        self._num_pieces += 1
        numbers = (np.array(pose), friction, mass_kg, np.array(inertia))
        placed = (piece.planes, piece.corners_m, *numbers)
        if self._solver is None:
            self._waiting.append(placed)
        else:
            self._solver.add_collider(*placed)
        return self._num_pieces - 1

    def _begun(self) -> SoftSolver:
        if self._solver is None:
            self._solver = SoftSolver(self._period_s, SUBSTEPS, self._config.gravity_m_s2)
            for placed in self._waiting:
                self._solver.add_collider(*placed)
            self._waiting.clear()
            self._add_links()
        return self._solver

    def _add_links(self) -> None:
        config = self._config
        for link, pieces in link_pieces(*self._description).items():
            if link not in self._arm.links:
                continue  # PyBullet has no number for the root; it stands still on the table
            finger = self._arm.links[link] in self._arm.finger_links
            friction = config.finger_friction if finger else config.surface_friction
            numbers = [
                self._add(piece, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), friction) for piece in pieces
            ]
            self._link_pieces[link] = numbers
            self._link_of |= dict.fromkeys(numbers, link)
            self._link_ids.append(self._arm.links[link])
        self.place_links()

    def place_links(self) -> None:
        """Take the robot's links to be where they are now, without having moved there."""
        if self._solver is None:
            return
        poses = self._arm.link_poses(self._link_ids)
        for pieces, (p, q) in zip(self._link_pieces.values(), poses, strict=True):
            for piece in pieces:
                self._solver.place(piece, np.array([*p, *q]))

    def add(
        self, object_id: str, model: SoftModel, T_base_object: Float[np.ndarray, "4 4"]
    ) -> None:
        """Add a soft body at rest."""
        rest = model.nodes_m.astype(np.float64)
        friction = self._config.object_friction
        index, _ = add_body(self._begun(), model, T_base_object, friction=friction)
        skin, points = None, rest
        if model.skin_m is not None:
            points = model.skin_m.astype(np.float64)
            skin = bind_points(points, rest, model.tets)
        self.names[object_id] = _SoftBody(
            index=index,
            model=model,
            skin=skin,
            rest_extents_m=np.ptp(points, axis=0),
        )

    def push_rigid(self) -> None:
        """Hand to the robot what the soft bodies did in the last step."""
        opening = 0.0
        wrenches: dict[str | None, list[float]] = {}
        for piece in self._pushed:
            link = self._link_of.get(piece)
            if link is None:
                continue
            p, q = self._states[link]
            row = (self._pushes[piece, :6] / self._period_s).tolist()
            force, moment = tuple(row[:3]), tuple(row[3:])
            finger = self._arm.links[link] in self._arm.finger_links
            if finger:
                opening += _dot(force, _rotated(q, self._arm.opening_axes[link]))
            # The fingers' own forces meet in what carries them; their drive feels the rest.
            wrench = wrenches.setdefault(None if finger else link, [0.0] * 6)
            for k, value in enumerate((*force, *_sum(moment, _cross(p, force)))):
                wrench[k] += value
        for carrier, wrench in wrenches.items():
            force, moment = tuple(wrench[:3]), tuple(wrench[3:])
            size = _dot(force, force)
            # Where the force alone has the moment, but for a twist about itself.
            point = tuple(value / size for value in _cross(force, moment)) if size else force
            self._arm.push(carrier, force, point)
        if wrenches or self._yields:
            self._arm.yield_fingers(opening / len(self._arm.finger_links))
        self._yields = bool(wrenches)

    def step(self) -> None:
        """Advance the soft bodies to where PyBullet is."""
        if self._solver is None:
            return
        self._fits.clear()
        links = self._arm.link_poses(self._link_ids)
        self._states = dict(zip(self._link_pieces, links, strict=True))
        states = [self._states[link] for link in self._link_of.values()]
        states += [self._client.getBasePositionAndOrientation(body) for body in self._free]
        driven = np.array([*self._link_of, *self._free.values()], dtype=np.int32)
        self._solver.step(driven, np.array([(*p, *q) for p, q in states]))
        self._pushed, self._pushes = self._solver.pushed(), self._solver.pushes()
        for body, piece in self._free.items():
            change = self._pushes[piece, 6:]
            if change.any():
                self._change(body, change)

    def _change(self, body: int, change: Float[np.ndarray, "9"]) -> None:
        """Add to the speed, the turning and the place of a box."""
        p, q = self._client.getBasePositionAndOrientation(body)
        v, omega = self._client.getBaseVelocity(body)
        self._client.resetBasePositionAndOrientation(body, (np.array(p) + change[6:]).tolist(), q)
        self._client.resetBaseVelocity(
            body, (np.array(v) + change[:3]).tolist(), (np.array(omega) + change[3:6]).tolist()
        )

    def nodes_m(self, object_id: str) -> Float[np.ndarray, "num_nodes 3"]:
        """Where a body's nodes are."""
        return np.asarray(self._begun().nodes(self.names[object_id].index))

    def T_base_object(self, object_id: str) -> Float[np.ndarray, "4 4"]:
        """Rigid motion nearest to a body's nodes; of a body that burst no numbers."""
        # Pose and extents of one state ask for the same fit.
        if object_id not in self._fits:
            model = self.names[object_id].model
            rest_m, weights = (a.astype(np.float64) for a in (model.nodes_m, model.mass_fraction))
            fit = rigid_fit(rest_m, self.nodes_m(object_id), weights)
            fit.setflags(write=False)
            self._fits[object_id] = fit
        return self._fits[object_id]

    def extents_m(self, object_id: str) -> Float[np.ndarray, "3"]:
        """Extents of a body's surface along the axes of its pose."""
        body, nodes = self.names[object_id], self.nodes_m(object_id)
        local = nodes @ self.T_base_object(object_id)[:3, :3]
        points = local if body.skin is None else body.skin.points_m(local)
        # Column by column: NumPy takes ten times as long along the long axis of three columns.
        extents = np.array([np.ptp(np.ascontiguousarray(column)) for column in points.T])
        return np.asarray(extents / body.rest_extents_m * body.model.size_m)

    def health(self, object_id: str) -> SoftHealth:
        """Whether a body is sound."""
        return health_of(self.names[object_id].model, self.nodes_m(object_id))

    def finger_touches(self, object_id: str) -> bool:
        """Whether a finger touched a body in the last step."""
        touched = set(self._begun().touched(self.names[object_id].index))
        return any(
            self._arm.links[link] in self._arm.finger_links and not touched.isdisjoint(pieces)
            for link, pieces in self._link_pieces.items()
        )


def _pose(T: Float[np.ndarray, "4 4"]) -> tuple[float, ...]:
    q, p = se3.split(T)
    w, x, y, z = q.tolist()
    return (*p.tolist(), x, y, z, w)
