"""The robot's convex hulls, shared by pinocchio, coal and PyBullet, and their signed distances."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float
from scipy.spatial import ConvexHull

from twin.robot.model import RobotDescriptionError, RobotModel

# Convex hulls of the robot's links, the one shape that pinocchio, coal and PyBullet all share.
# TRAP (measured, design page on physics): ``BVHModel.buildConvexRepresentation`` reuses the
# concave triangles of the mesh; distances then come out up to 95 mm too large, which is the
# unsafe side. ``ConvexBase.convexHull`` computes a true hull; a test pins hull distance <= mesh
# distance.

_CYLINDER_SIDES, _FEW = 24, 200
_THINNEST_M = 1e-7


@dataclass(frozen=True, kw_only=True)
class LinkHull:
    """One convex piece of a link, its points in the link's frame."""

    link: str
    points_m: Float[np.ndarray, "num_points 3"]
    shape: coal.ConvexBase
    from_mesh: bool
    """False where the description has a box or a cylinder."""


def convex_hull(points_m: Float[np.ndarray, "num_points 3"]) -> coal.ConvexBase:
    """Return the true convex hull of points, as coal wants it."""
    stored = coal.StdVec_Vec3s()
    for point in points_m:
        stored.append(np.asarray(point, dtype=np.float64))
    try:
        return coal.ConvexBase.convexHull(stored, True, "Qt")
    except RuntimeError:  # a corner with more than 255 neighbours
        return convex_hull(_fewer_around(points_m))


def _fewer_around(points_m: Float[np.ndarray, "num_points 3"]) -> Float[np.ndarray, "few 3"]:
    """Some of the points, moved away from their middle until their hull contains all."""
    directions = np.random.default_rng(0).normal(size=(_FEW, 3))
    few = points_m[np.unique(np.argmax(points_m @ directions.T, axis=0))]
    middle = few.mean(axis=0)
    faces = ConvexHull(few - middle).equations
    share = ((points_m - middle) @ faces[:, :3].T / -faces[:, 3]).max()
    return np.asarray(middle + (few - middle) * max(1.0, share))


def collision_geometry(model: pin.Model, urdf: str) -> pin.GeometryModel:
    """Read the collision shapes of a description."""
    try:
        return pin.buildGeomFromUrdfString(model, urdf, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(
            f"has collision shapes that cannot be read ({str(error)[:200]})",
            "Check its mesh files.",
        ) from error


def link_hulls(robot: RobotModel) -> list[LinkHull]:
    """Return one hull for each collision element of the description."""
    geometry = collision_geometry(robot.model, robot.urdf)
    hulls = []
    for item in geometry.geometryObjects:
        frame = robot.model.frames[item.parentFrame]
        T_link_shape = frame.placement.inverse() * item.placement
        points = corners_of(item) @ T_link_shape.rotation.T + T_link_shape.translation
        if not _has_volume(points):
            raise RobotDescriptionError(
                f"has a collision shape without volume at the link {frame.name!r}",
                "Give it three extents above zero, or leave it out.",
            )
        shape = convex_hull(points)
        corners = np.array(shape.points())
        from_mesh = isinstance(item.geometry, coal.BVHModelBase)
        hulls.append(LinkHull(link=frame.name, points_m=corners, shape=shape, from_mesh=from_mesh))
    if not hulls:
        raise RobotDescriptionError(
            "gives no link a collision shape",
            "Give each link <collision>, or nothing would be watched.",
        )
    return hulls


def _has_volume(points_m: Float[np.ndarray, "num_points 3"]) -> bool:
    """Whether points span a body; of others coal ends the process."""
    if len(points_m) < 4 or not np.isfinite(points_m).all():
        return False
    spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(spread[2] > _THINNEST_M)


def corners_of(item: pin.GeometryObject) -> Float[np.ndarray, "num_points 3"]:
    """Points whose hull contains a collision shape, in its own frame [m]."""
    shape = item.geometry
    if isinstance(shape, coal.BVHModelBase):
        return np.array(shape.vertices())
    if isinstance(shape, coal.ConvexBase):
        return np.array(shape.points())
    if isinstance(shape, coal.Box):
        corners: Float[np.ndarray, "8 3"] = np.array(list(product((-1.0, 1.0), repeat=3)))
        corners *= np.array(shape.halfSide)
        return corners
    if isinstance(shape, coal.Sphere):
        return _circumscribed(float(shape.radius))
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        angle = np.arange(_CYLINDER_SIDES) * 2 * np.pi / _CYLINDER_SIDES
        # Corners on the circumscribed circle: the prism contains the cylinder (safe side).
        radius = shape.radius / np.cos(np.pi / _CYLINDER_SIDES)
        ring = np.stack([np.cos(angle) * radius, np.sin(angle) * radius], axis=1)
        ends = [np.column_stack([ring, np.full(len(ring), s)]) for s in (-1, 1)]
        prism: Float[np.ndarray, "num_points 3"] = np.concatenate(ends)
        prism[:, 2] *= shape.halfLength + shape.radius * isinstance(shape, coal.Capsule)
        return prism
    raise RobotDescriptionError(
        f"has a collision shape {type(shape).__name__} at {item.name}",
        "Known: mesh, box, cylinder, sphere, capsule.",
    )


def _circumscribed(radius_m: float) -> Float[np.ndarray, "num_points 3"]:
    """Points whose hull contains a sphere: on rings about z, farther out than the sphere."""
    step = np.pi / (_CYLINDER_SIDES // 2)
    angles = np.arange(_CYLINDER_SIDES) * step
    tilts, ones = np.arange(0, _CYLINDER_SIDES // 2 + 1)[:, None] * step, np.ones(len(angles))
    rings = [np.sin(tilts) * np.cos(angles), np.sin(tilts) * np.sin(angles), np.cos(tilts) * ones]
    points: Float[np.ndarray, "num_points 3"] = np.stack(rings, axis=-1).reshape(-1, 3)
    # A face between neighbouring points lies inside the sphere by at most two half steps.
    return np.asarray(points * (radius_m / np.cos(step / 2) ** 2))


_SAMPLES = 60
_ALWAYS = 0.95
"""Pairs that overlap in this share of random postures overlap by construction of their hulls."""
_WIDTH_M = 0.04
"""Opening in those postures, where the gripper is as wide."""

_MOST_LEFT_OUT, _LONGEST_M = 0.2, 30.0

_SIGNED = coal.DistanceRequest()
_SIGNED.enable_signed_distance = True
_DIGITS = 7
"""Distances are exact to a micrometre (the tolerance of GJK). What lies below a tenth of one may
depend on what coal computed before, in tests by 3e-13 m: cut off, the same replay gives the same
bytes in every process."""


def signed_distance(
    first: coal.CollisionGeometry,
    T_first: coal.Transform3s,
    second: coal.CollisionGeometry,
    T_second: coal.Transform3s,
    result: coal.DistanceResult | None = None,
) -> float:
    """Distance between two convex shapes [m], negative by the depth when they overlap.

    A fresh ``result`` is filled with the nearest points and the direction between them.
    """
    result = coal.DistanceResult() if result is None else result
    distance_m = float(coal.distance(first, T_first, second, T_second, _SIGNED, result))
    return round(distance_m, _DIGITS)


class RobotHulls:
    """The hulls of a robot, placed for one posture at a time."""

    def __init__(self, robot: RobotModel) -> None:
        """Build the hulls and choose the pairs of links that must stay apart."""
        self.robot = robot
        self.hulls: list[LinkHull] = link_hulls(robot)
        self._frame_ids = [robot.frame_id(hull.link) for hull in self.hulls]
        # Views of pinocchio's own memory: to ask for them costs more than the kinematics.
        frames = [robot.data.oMf[frame_id] for frame_id in self._frame_ids]
        self._rotation_views = [frame.rotation for frame in frames]
        self._translation_views = [frame.translation for frame in frames]
        self.rotations: Float[np.ndarray, "num_hulls 3 3"] = np.zeros((len(self.hulls), 3, 3))
        self.translations: Float[np.ndarray, "num_hulls 3"] = np.zeros((len(self.hulls), 3))
        self._rotation_rows = self.rotations.reshape(-1, 3)
        self._translation_row = self.translations.reshape(-1)
        self._placements: dict[int, coal.Transform3s] = {}
        self.left_out: dict[str, str] = {}
        """Pairs of links that are not watched, with the reason."""
        self.share_left_out = 0.0
        self.pairs = self._pairs()

    def place(self, joints_rad: Float[np.ndarray, " num_joints"], width_m: float) -> None:
        """Move all hulls to a posture."""
        robot = self.robot
        pin.framesForwardKinematics(
            robot.model, robot.data, robot.configuration(joints_rad, width_m)
        )
        np.concatenate(self._rotation_views, out=self._rotation_rows)
        np.concatenate(self._translation_views, out=self._translation_row)
        self._placements.clear()

    def placement(self, index: int) -> coal.Transform3s:
        """Where a hull is, as coal wants it; few are asked for in most postures."""
        placed = self._placements.get(index)
        if placed is None:
            placed = coal.Transform3s(self.rotations[index], self.translations[index])
            self._placements[index] = placed
        return placed

    def self_distance(self) -> tuple[float, tuple[str, str]]:
        """Distance [m] and links of the closest pair that should stay apart; infinite: none."""
        best, links = np.inf, ("", "")
        for first, second in self.pairs:
            distance = self.distance_m(first, second)
            if distance < best:
                best, links = distance, (self.hulls[first].link, self.hulls[second].link)
        return best, links

    def distance_m(self, first: int, second: int) -> float:
        """Signed distance of two hulls, by their numbers [m]."""
        return signed_distance(
            self.hulls[first].shape,
            self.placement(first),
            self.hulls[second].shape,
            self.placement(second),
        )

    def _pairs(self) -> list[tuple[int, int]]:
        """All pairs but neighbours, the two fingers, and hulls that overlap by construction.

        That is: in every posture, in the one at home, or because the robot file says so.
        """
        fingers = set(self.robot.record.gripper.finger_links)
        joints = [self.robot.model.frames[frame_id].parentJoint for frame_id in self._frame_ids]
        parents = self.robot.model.parents
        candidates = [
            (first, second)
            for first in range(len(self.hulls))
            for second in range(first + 1, len(self.hulls))
            if joints[first] != joints[second]
            and parents[joints[second]] != joints[first]
            and parents[joints[first]] != joints[second]
            and not {self.hulls[first].link, self.hulls[second].link} <= fingers
        ]
        robot = self.robot
        low, high = np.maximum(robot.lower_rad, -np.pi), np.minimum(robot.upper_rad, np.pi)
        width_m = min(_WIDTH_M, robot.record.gripper.max_width_m)
        self.place(robot.home_rad, width_m)
        self._leave_out(candidates, self._listed, "the robot file lists them under may_overlap")
        self._leave_out(candidates, lambda *p: self.distance_m(*p) <= 0, "they touch at home")
        rng = np.random.default_rng(0)
        overlaps = dict.fromkeys(candidates, 0)
        for _ in range(_SAMPLES):
            self.place(rng.uniform(low, high), width_m)
            for pair in candidates:
                overlaps[pair] += self.distance_m(*pair) <= 0
        most = _ALWAYS * _SAMPLES
        self._leave_out(candidates, lambda *p: overlaps[p] >= most, "they touch in every posture")
        return candidates

    def _leave_out(
        self, pairs: list[tuple[int, int]], which: Callable[[int, int], bool], why: str
    ) -> None:
        found = [pair for pair in pairs if which(*pair)]
        pairs[:] = [pair for pair in pairs if pair not in found]
        links = sorted({f"{self.hulls[a].link} and {self.hulls[b].link}" for a, b in found})
        self.left_out.update(dict.fromkeys(links, why))
        self.share_left_out += len(found) / (len(pairs) + len(found) or 1)

    def oversized(self) -> str | None:
        """Name what is too long for an arm, or for this one, with what may be wrong with it."""
        model = self.robot.model
        reach_m = sum(float(np.linalg.norm(T.translation)) for T in model.jointPlacements)
        if reach_m > _LONGEST_M:
            return f"the joints lie {reach_m:.0f} m apart; are their origins in millimetres?"
        for hull in self.hulls:
            body = model.getFrameId(hull.link, pin.FrameType.BODY)
            length_m = float(np.ptp(hull.points_m, axis=0).max())
            if model.frames[body].parentJoint and not length_m <= reach_m:
                told = f"is {length_m:.0f} m long; is it in millimetres? Set its scale"
                return f"a collision shape of the link {hull.link!r} {told}"
        return None

    def blind(self) -> str | None:
        """Say what is not watched, so that no motion of this arm can be called clear of itself."""
        bare = sorted(self.robot.bodies - {hull.link for hull in self.hulls})
        if bare:
            return f"the links {', '.join(bare)} have no collision shapes: nobody watches them"
        many = self.share_left_out > _MOST_LEFT_OUT
        pairs = "; ".join(f"{links}, for {why}" for links, why in self.left_out.items())
        told = f"{self.share_left_out:.0%} of the pairs of links are not watched: {pairs}"
        return self.oversized() or (told if many else None)

    def _listed(self, first: int, second: int) -> bool:
        links = {self.hulls[first].link, self.hulls[second].link}
        return any(links == set(pair) for pair in self.robot.record.may_overlap)


@lru_cache(maxsize=4)
def hulls_of(robot: RobotModel) -> RobotHulls:
    """Return the hulls of a robot, built once."""
    return RobotHulls(robot)
