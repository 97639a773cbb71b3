"""All grasps of one object that the hand can reach, the surest first, and why others are none."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from bridge.geometry import se3
from twin.physics.config import PhysicsConfig
from twin.plan.grasp.margin import Doubt, Lines, margins, slacks
from twin.plan.grasp.open_hand import has_fingers, open_hand
from twin.plan.grasp.pairs import Pairs, SampledSurface, antipodal_pairs, thinned
from twin.plan.grasp.reach import ArmReach
from twin.plan.problem import (
    Covariance,
    Flags,
    Grasp,
    Ids,
    NoPlanError,
    Numbers,
    Points,
    Pose,
    Poses,
    Problem,
)
from twin.plan.stage.solver import alike
from twin.replay.config import UNKNOWN_POSE_M, UNKNOWN_POSE_RAD

CAUSES: Mapping[str, str] = {
    "cone": "no two surfaces face each other within the friction cone",
    "width": "what faces each other is wider than the hand opens",
    "unseen": "what could be taken was seen by no camera",
    "tilt": "the hand would have to come too far from the side",
    "table": "the hand would meet the table",
    "palm": "it is taller there than the hand is deep",
    "fingers": "a finger would come down on the object",
    "neighbour": "something beside it is in the hand's way",
    "margin": "a grasp would bear less than the pose is uncertain",
    "reach": "the arm reaches no grasp",
    "approach": "the arm cannot follow the straight approach",
    "arm": "arm or hand would touch what stands around",
}
"""Why candidates are rejected, in the order in which they are looked at."""
HINTS: Mapping[str, str] = {
    "width": "Take it at a narrower place, or use a wider gripper.",
    "unseen": "Scan it from lower down.",
    "table": "Take something higher, or turn the object.",
    "palm": "Take it higher up.",
    "neighbour": "Move what is beside it first.",
    "margin": "Localise it again, nearer or with more frames.",
    "reach": "Move the object nearer to the arm.",
    "arm": "Move the object away from what stands around.",
}


def no_grasp(object_id: str, cause: str, found: str, hint: str) -> NoPlanError:
    """An object cannot be taken hold of; why, in one word and in more."""
    return NoPlanError(f"no grasp of {object_id}: {found}. {hint}", cause=cause)


FRICTION = 0.5
"""Least friction coefficient between pads and object that a grasp must hold with."""
CONE_RAD = float(np.arctan(FRICTION))
APPROACHES_RAD = (0.0, -0.35, 0.35, -0.7, 0.7)
"""Turns about the closing line, from the approach nearest to straight down."""
MOST_TILT_RAD = 0.9
"""Of the approach from straight down."""
DEPTHS_M = (0.0, -0.005, 0.012)
"""How far the tool centre point goes beyond the closing line."""
PREGRASP_M = 0.08
ROBOT_ERROR_M = 0.0015
"""Standard deviation of the tool in any direction."""
CLEARANCE_M = 0.003
"""Between each pad and the object, and between the hand and anything else."""
SEED = 0


@dataclass(frozen=True, kw_only=True)
class GraspConfig:
    """How grasps are searched."""

    samples: int = 800
    """Points of the surface that closing lines start from."""
    least_margin: float = 1.0
    """Standard deviations that a grasp must bear."""
    most: int = 60


@dataclass(frozen=True, kw_only=True)
class GraspSearch:
    """What a search found."""

    grasps: tuple[Grasp, ...]
    rejected: Mapping[str, int]
    """Candidates by the cause for which they are none; see ``CAUSES``."""
    remarks: tuple[str, ...] = ()


@dataclass
class _Candidates:
    """Hands on closing lines, object frame; fields are in step."""

    lines: Lines
    rejected: Counter[str] = field(default_factory=Counter)

    def keep(self, mask: Flags, cause: str) -> None:
        """Reject the others."""
        self.rejected[cause] += int((~mask).sum())
        self.lines = self.lines.chosen(mask)

    def __len__(self) -> int:
        return len(self.lines.widths_m)


_TARGET_POINTS = 500
_NEIGHBOUR_POINTS = 900
_UNDERSIDE = 0.5
"""Sine under the horizontal of a scanned surface that no camera above the table sees."""
_CELLS_M, _CELL_RAD = (0.003, 0.004, 0.005, 0.006, 0.008, 0.010, 0.013), 0.2
"""Closing lines that share such a cell are one; the first that leaves few enough of them."""
_MOST_LINES = 180
_TWIST_SHARE = 2 / 3
"""Of the pad's half breadth, the radius at which its friction resists turning: that of a disc."""
_SAFETY = 1.5
"""On the weight that friction must hold: the arm accelerates too."""
_MIDDLE_SHARE = 0.05
"""Of its largest extent, how far the middle of an object's mass may be off."""
_COVERED_M = 0.006
"""Something whose underside is no more than this under the top of what it covers lies on it."""


class GraspSearcher:
    """Searches grasps in one start; made once per problem, asked per object."""

    def __init__(self, problem: Problem, config: GraspConfig | None = None) -> None:
        """Lay out what all searches share."""
        self.problem = problem
        self.config = GraspConfig() if config is None else config
        robot = problem.robot
        if not has_fingers(robot):
            found = f"{robot.record.name} has no fingers that close"
            hint = "Give its gripper in the robot file (docs/robots.md)."
            raise no_grasp("anything", "no_gripper", found, hint)
        self._hand = open_hand(robot, robot.record.gripper.max_width_m, PREGRASP_M)
        self._reach = ArmReach(problem)
        self._surfaces: dict[str, SampledSurface] = {}

    def search(self, object_id: str) -> GraspSearch:
        """Find grasps of an object."""
        self._refuse_covered(object_id)
        self._refuse_too_heavy(object_id)
        T = self.problem.scene.Ts_base_object[object_id]
        pairs, rejected = self._pairs(object_id)
        found = self._hands_on(pairs, T, rejected)
        points = self._surface(object_id).points(_TARGET_POINTS, SEED)[0]
        table_m = self.problem.scene.table_height_m + CLEARANCE_M
        found.keep(self._hand.lowest_m(T @ found.lines.Ts_object_tcp) >= table_m, "table")
        hits = self._hand.hits(in_tools(found.lines, points), CLEARANCE_M / 2)
        fingers = hits["fingers"][~hits["palm"]]
        found.keep(~hits["palm"], "palm")
        found.keep(~fingers, "fingers")
        self._past_neighbours(found, object_id, T)
        margin = self._margins(found, object_id, points)
        grasps = self._choose(found, margin, object_id)
        if not grasps:
            raise self._none(object_id, found.rejected)
        remarks = self._remarks(object_id)
        return GraspSearch(grasps=grasps, rejected=+found.rejected, remarks=remarks)

    def _refuse_covered(self, object_id: str) -> None:
        """Refuse what something lies on: lifting it would throw that down."""
        scene, shapes = self.problem.scene, self.problem.shapes
        own = se3.apply(scene.Ts_base_object[object_id], shapes[object_id].vertices_m)
        try:
            sides = ConvexHull(own[:, :2]).equations
        except (QhullError, ValueError):
            return
        top_m = float(own[:, 2].max())
        for name, T in scene.movable().items():
            if name == object_id:
                continue
            other = se3.apply(T, self._surface(name).points(_NEIGHBOUR_POINTS, 0)[0])
            over = other[(other[:, :2] @ sides[:, :2].T + sides[:, 2] <= 0).all(axis=1)]
            if len(over) and over[:, 2].min() > top_m - _COVERED_M:
                found, hint = f"{name} is on top of it", f"Move {name} away first."
                raise no_grasp(object_id, "covered", found, hint)

    def _refuse_too_heavy(self, object_id: str) -> None:
        model = self.problem.model(object_id)
        weight_N = model.mass_kg * PhysicsConfig().gravity_m_s2 * _SAFETY
        held_N = 2 * FRICTION * self._grip_N()
        if weight_N > held_N:
            found = f"friction holds {held_N:.0f} N, and lifting {model.mass_kg:.2f} kg takes up "
            found += f"to {weight_N:.0f} N"
            hint = "Press harder (grip_force_N of the task file), or take something lighter."
            raise no_grasp(object_id, "weight", found, hint)

    def _grip_N(self) -> float:
        given = self.problem.scene.task.grip_force_N
        return PhysicsConfig().grip_force_N if given is None else given

    def _covariance(self, object_id: str) -> Covariance:
        known = self.problem.scene.covariances.get(object_id)
        if known is not None:
            return known
        sigma = [UNKNOWN_POSE_M] * 3 + [UNKNOWN_POSE_RAD] * 3
        return np.diag(np.square(sigma))

    def _surface(self, object_id: str) -> SampledSurface:
        if object_id not in self._surfaces:
            self._surfaces[object_id] = SampledSurface(self.problem.shapes[object_id])
        return self._surfaces[object_id]

    def _pairs(self, object_id: str) -> tuple[Pairs, Counter[str]]:
        """Closing lines that hold, fit between the pads, and are on what was seen."""
        config, shape = self.config, self.problem.shapes[object_id]
        rejected: Counter[str] = Counter()
        kept: Ids = np.zeros(0, dtype=np.int64)
        pairs = antipodal_pairs(
            self._surface(object_id),
            count=config.samples,
            cone_rad=CONE_RAD,
            hint_m=self.problem.model(object_id).grasp_m,
            seed=SEED,
        )

        def keep(pairs: Pairs, mask: Flags, cause: str) -> Pairs:
            rejected[cause] += int((~mask).sum())
            return pairs.chosen(mask)

        pairs = keep(pairs, pairs.cosines >= np.cos(CONE_RAD), "cone")
        pairs = keep(pairs, pairs.widths_m <= self._hand.open_m - 2 * CLEARANCE_M, "width")
        seen = pairs.lowest_m >= shape.trusted_from_m
        if np.isfinite(shape.trusted_from_m):
            seen &= pairs.downward <= _UNDERSIDE
        pairs = keep(pairs, seen, "unseen")
        for cell_m in _CELLS_M:
            kept = thinned(pairs, cell_m=cell_m, cell_rad=_CELL_RAD)
            if len(kept) <= _MOST_LINES:
                break
        return pairs.chosen(kept), rejected

    def _hands_on(self, pairs: Pairs, T_base_object: Pose, rejected: Counter[str]) -> _Candidates:
        """Put hands onto closing lines, from several directions and at several depths."""
        down = -T_base_object[2, :3]
        signs = (1.0,) if self._hand.symmetric else (1.0, -1.0)
        ways = np.array(list(product(signs, APPROACHES_RAD, DEPTHS_M)))
        sign, turn, depth = np.repeat(ways, len(pairs.axes), axis=0).T[..., None]
        pairs = pairs.chosen(np.tile(np.arange(len(pairs.axes)), len(ways)))
        y = pairs.axes
        steep = down - y * (y @ down)[:, None]
        length = np.linalg.norm(steep, axis=1)
        z0 = steep / np.maximum(length, 1e-9)[:, None]
        z = np.cos(turn) * z0 + np.sin(turn) * np.cross(y, z0)
        Ts = np.tile(np.eye(4), (len(y), 1, 1))
        Ts[:, :3, :3] = np.stack([sign * np.cross(y, z), sign * y, z], axis=-1)
        Ts[:, :3, 3] = pairs.middles_m + depth * z
        lines = Lines(
            Ts_object_tcp=Ts,
            middles_m=pairs.middles_m,
            widths_m=pairs.widths_m,
            cosines=pairs.cosines,
        )
        level = (Ts[:, :3, 2] @ down >= np.cos(MOST_TILT_RAD)) & (length > 1e-6)
        found = _Candidates(lines=lines, rejected=rejected)
        found.keep(level, "tilt")
        return found

    def _past_neighbours(self, found: _Candidates, object_id: str, T_base_object: Pose) -> None:
        """Reject hands that another object is in the way of, wherever it may be off to."""
        scene, T_object_base = self.problem.scene, se3.invert(T_base_object)
        for name, T in scene.Ts_base_object.items():
            if name == object_id:
                continue
            sigma_m = float(np.sqrt(np.abs(np.diag(self._covariance(name))[:3]).max()))
            margin_m = CLEARANCE_M + sigma_m
            points = self._surface(name).points(_NEIGHBOUR_POINTS, SEED)[0]
            points = in_tools(found.lines, se3.apply(T_object_base @ T, points))
            hits = self._hand.hits(points, margin_m)
            found.keep(~(hits["fingers"] | hits["palm"]), "neighbour")

    def _margins(self, found: _Candidates, object_id: str, points_m: Points) -> Numbers:
        """How much each grasp bears; those that bear too little are rejected."""
        hand, config, model = self._hand, self.config, self.problem.model(object_id)
        T = self.problem.scene.Ts_base_object[object_id]
        twist_Nm = 2 * FRICTION * self._grip_N() * _TWIST_SHARE * hand.pad_half_m
        weight_N = max(model.mass_kg * PhysicsConfig().gravity_m_s2, 1e-9)
        low_m = hand.lowest_m(T @ found.lines.Ts_object_tcp)
        slack = slacks(
            self._surface(object_id),
            found.lines,
            hand,
            in_tools(found.lines, points_m),
            over_table_m=low_m - self.problem.scene.table_height_m,
            cone_rad=CONE_RAD,
            lever_m=twist_Nm / weight_N,
        )
        error_m = self.problem.shapes[object_id].error_m
        doubt = Doubt(
            covariance=self._covariance(object_id),
            other_m=float(np.hypot(ROBOT_ERROR_M, error_m)),
            robot_m=ROBOT_ERROR_M,
            middle_m=_MIDDLE_SHARE * max(model.size_m),
        )
        margin = margins(slack, found.lines, T, doubt)
        enough = margin >= config.least_margin
        found.keep(enough, "margin")
        return margin[enough]

    def _choose(self, found: _Candidates, margin: Numbers, object_id: str) -> tuple[Grasp, ...]:
        """Take the surest that the arm reaches, leaving out what is like one that was taken."""
        hand, config, lines = self._hand, self.config, found.lines
        Ts = self.problem.scene.Ts_base_object[object_id] @ lines.Ts_object_tcp
        taken: list[Grasp] = []
        kept: list[int] = []
        for index in np.argsort(-margin, kind="stable").tolist():
            mine = lines.Ts_object_tcp[[index]]
            hands = [*mine, *turned(mine)] if hand.symmetric else [*mine]
            if any(alike(lines.Ts_object_tcp[kept], T).any() for T in hands):
                continue
            way = self._reach.first(Ts[index], hand, PREGRASP_M)
            if isinstance(way, str):
                found.rejected[way] += 1
                continue
            joints_rad, is_turned = way
            kept.append(index)
            T_object_tcp = lines.Ts_object_tcp[index]
            taken.append(
                Grasp(
                    object_id=object_id,
                    T_object_tcp=turned(T_object_tcp[None])[0] if is_turned else T_object_tcp,
                    width_m=float(lines.widths_m[index]),
                    open_m=hand.open_m,
                    margin=float(margin[index]),
                    joints_rad=joints_rad,
                    pregrasp_m=PREGRASP_M,
                )
            )
            if len(taken) == config.most:
                break
        return tuple(taken)

    def _remarks(self, object_id: str) -> tuple[str, ...]:
        scene = self.problem.scene
        remarks = [f"surface: {self.problem.shapes[object_id].source}"]
        if object_id not in scene.covariances:
            sigma_m = UNKNOWN_POSE_M
            remarks.append(f"nobody says how sure its pose is: {sigma_m * 1e3:.0f} mm assumed")
        return tuple(remarks)

    def _none(self, object_id: str, rejected: Mapping[str, int]) -> NoPlanError:
        """Name what rejected the candidates that came furthest."""
        cause = [name for name in CAUSES if rejected.get(name)][-1:] or ["cone"]
        found = CAUSES[cause[0]]
        if cause[0] == "width":
            found += f" ({self._hand.open_m * 1e3:.0f} mm)"
        if cause[0] == "palm":
            found += f" ({self._hand.depth_m * 1e3:.0f} mm)"
        counted = ", ".join(f"{name} {rejected[name]}" for name in CAUSES if rejected.get(name))
        found += f" (rejected: {counted or 'nothing was found'})"
        hint = HINTS.get(cause[0], "Turn the object, or take another one.")
        return no_grasp(object_id, cause[0], found, hint)


def turned(Ts: Poses) -> Poses:
    """The same hands turned half about their approach."""
    return np.asarray(Ts * np.array([-1.0, -1.0, 1.0, 1.0]))


def in_tools(lines: Lines, points_m: Points) -> Float[np.ndarray, "3 num_grasps num_points"]:
    """Points of the object, in the tool frame of each grasp: all x, then y, then z."""
    R, p = lines.Ts_object_tcp[:, :3, :3], lines.Ts_object_tcp[:, :3, 3]
    # One product, not one for each grasp.
    turned_all = R.transpose(2, 0, 1).reshape(-1, 3) @ points_m.T
    found = turned_all.reshape(3, len(R), len(points_m))
    found -= np.einsum("nij,ni->jn", R, p)[..., None]
    return np.asarray(found)
