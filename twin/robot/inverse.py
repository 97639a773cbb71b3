"""Inverse kinematics: joints that put the tool centre point where a plan wants it.

Levenberg-Marquardt on the SE(3) error with a warm start, because the next waypoint of a
trajectory is near. Where it fails, the descent begins again from elsewhere: for UR-type arms from
the branches of the closed form, then from those of many random postures whose poses are nearest.
What a seventh joint leaves open goes towards home.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float
from scipy.linalg.lapack import dposv
from scipy.spatial import cKDTree

from bridge.geometry import se3
from twin.robot.model import RobotModel

Pose = Float[np.ndarray, "4 4"]
Joints = Float[np.ndarray, " num_joints"]
POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD = 0.0005, math.radians(0.1)
"""A pose counts as reached where the tool misses it by no more (errata resolution 9)."""
MAX_ITERATIONS = 60
"""Of one descent."""
_CONVERGED = 1e-8
"""Norm of the error twist at which iterating stops: far below the tolerance, so that a round
trip is exact and the tolerance decides feasibility only."""
_MAX_DAMPING = 1e3


@dataclass(frozen=True, kw_only=True)
class IkSolution:
    """Joints, and how far they miss the wanted pose."""

    joints_rad: Joints
    position_error_m: float
    rotation_error_rad: float
    reached: bool
    """Whether both errors are within the tolerance."""


def pose_error(robot: RobotModel, joints_rad: Joints, T_base_tcp: Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between where joints put the tool and a wanted pose."""
    error = pin.SE3(robot.T_base_tcp(joints_rad)).actInv(pin.SE3(T_base_tcp))
    return float(np.linalg.norm(error.translation)), float(np.linalg.norm(pin.log3(error.rotation)))


def solve_ik(
    robot: RobotModel, T_base_tcp: Pose, *, warm_start_rad: Joints | None = None, restarts: int = 20
) -> IkSolution:
    """The best joints within limits for a pose, by the warm start (None: home); see ``reached``.

    Where it fails so many other starts are tried; of arms without a closed form ten times as many.
    """
    start = robot.home_rad if warm_start_rad is None else warm_start_rad
    best = _descend(robot, T_base_tcp, start)
    if not best.reached and len(start) < NUM_POSE:
        return _position_first(robot, T_base_tcp, warm_start_rad, restarts)
    if not best.reached:
        best = _from_nearest(robot, T_base_tcp, best, start, restarts)
        return _nearer(robot, T_base_tcp, best, start) if best.reached else best
    if warm_start_rad is None and len(start) > NUM_POSE:
        return _nearer(robot, T_base_tcp, best, start)
    return best


NUM_POSE = 6
"""Numbers that a pose determines: joints beyond these are redundant."""
NUM_POSTURES = 4096
"""Random postures among which starts are chosen."""
_STARTS_PER_RESTART = 10
"""A pose out of reach then costs some tenths of a second, once for a plan."""
_TURN_M = 0.3
"""A turn by one radian counts as so many metres where poses are compared: an arm's last links."""


@lru_cache(maxsize=8)
def _postures(robot: RobotModel) -> tuple[Float[np.ndarray, "num_postures num_joints"], cKDTree]:
    """Random postures within the limits, one turn at most, and a tree of their tool poses."""
    rng = np.random.default_rng(0)
    middle = (robot.lower_rad + robot.upper_rad) / 2
    half = np.minimum(np.pi, (robot.upper_rad - robot.lower_rad) / 2)
    rows = middle + rng.uniform(-half, half, (NUM_POSTURES, len(middle)))
    return rows, cKDTree(_features(robot.Ts_base_tcp(rows)))


def _features(Ts: Float[np.ndarray, "num_poses 4 4"]) -> Float[np.ndarray, "num_poses 12"]:
    """Positions and scaled axes: near where poses are near."""
    axes = Ts[:, :3, :3].reshape(len(Ts), 9) * (_TURN_M / np.sqrt(2))
    return np.concatenate([Ts[:, :3, 3], axes], axis=1)


def _from_nearest(
    robot: RobotModel, T_base_tcp: Pose, best: IkSolution, near_rad: Joints, restarts: int
) -> IkSolution:
    """Begin at the branches of the closed form, then at the postures whose poses are nearest."""
    if not (np.isfinite(T_base_tcp).all() and restarts):
        return best
    rows, tree = _postures(robot)
    inverse, branches = UrInverse.for_robot(robot), rows[:0]
    if inverse is not None:  # it knows stretched arms
        raw, valid, _ = inverse.solve(T_base_tcp[None])
        branches = raw[0, valid[0]]
        branches = branches[np.abs(branches - near_rad).sum(axis=1).argsort(kind="stable")]
    count = restarts * (_STARTS_PER_RESTART if inverse is None else 1)
    found = tree.query(_features(T_base_tcp[None])[0], k=min(count, len(rows)))[1]
    for start_rad in (*branches, *rows[np.atleast_1d(found)]):
        other = _descend(robot, T_base_tcp, start_rad)
        if other.reached or other.position_error_m < best.position_error_m:
            best = other
        if best.reached:
            break
    return best


_TURN_WEIGHT, _LITTLE_RAD = 0.05, 0.35
"""Of a radian against a metre, where a tool cannot be turned at will; and what little is left."""


def _position_first(
    robot: RobotModel, T_base_tcp: Pose, warm_start_rad: Joints | None, restarts: int
) -> IkSolution:
    """Put the tool where it is wanted, turned as nearly so as an arm of few joints can.

    ``reached`` is of the position alone. What a warm start leads to is taken where little is left,
    so that a path stays one; else the posture that turns the tool best, of those near the pose.
    """
    enough_rad = ROTATION_TOLERANCE_RAD if warm_start_rad is None else _LITTLE_RAD
    tries = [(robot.home_rad if warm_start_rad is None else warm_start_rad, _TURN_WEIGHT)]
    if restarts and np.isfinite(T_base_tcp).all():
        rows, tree = _postures(robot)
        near = tree.query(_features(T_base_tcp[None])[0], k=3 * restarts)[1]
        tries += [(rows[index], _TURN_WEIGHT) for index in near]
        away_m = np.linalg.norm(tree.data[:, :3] - T_base_tcp[:3, 3], axis=1)
        tries += [(rows[index], 0.0) for index in np.argsort(away_m)[:restarts]]
    found: list[tuple[bool, float, int, IkSolution]] = []
    for start_rad, weight in tries:
        if not weight and not min(found)[0]:
            break
        turned = _descend(robot, T_base_tcp, start_rad, weight)
        other = _descend(robot, T_base_tcp, turned.joints_rad, 0.0)
        is_there = other.position_error_m <= POSITION_TOLERANCE_M
        missed = other.rotation_error_rad if is_there else other.position_error_m
        found.append((not is_there, missed, len(found), replace(other, reached=is_there)))
        if is_there and missed <= enough_rad:
            break
    return min(found)[3]


_DISTINCT_RAD = 0.5
_MOST_SOLUTIONS = 8
_LOOKED_AT = 80
"""Nearest known postures from which further solutions are looked for."""


def solutions(robot: RobotModel, T_base_tcp: Pose) -> Iterator[IkSolution]:
    """Yield what ``solve_ik`` finds, then other solutions of an arm without a closed form.

    Each differs from all before by half a radian in some joint. They are looked for one at a time.
    """
    first = solve_ik(robot, T_base_tcp)
    yield first
    if not first.reached:
        return
    rows, tree = _postures(robot)
    found = [first.joints_rad]
    _, near = tree.query(_features(T_base_tcp[None])[0], k=_LOOKED_AT)
    for index in near.tolist():
        other = _descend(robot, T_base_tcp, rows[index])
        away = other.joints_rad - np.array(found)
        if other.reached and np.abs(away).max(axis=1).min() > _DISTINCT_RAD:
            yield other
            found.append(other.joints_rad)
            if len(found) == _MOST_SOLUTIONS:
                return


_TOWARDS = 40
"""Steps towards a wanted posture within what the pose leaves open."""
_STEP_RAD, _SETTLED_RAD = 0.3, 1e-3
"""Longest such step, and one that is none."""


def _nearer(
    robot: RobotModel, T_base_tcp: Pose, found: IkSolution, wanted_rad: Joints
) -> IkSolution:
    """Go from a solution to the one near it that is nearest to a posture.

    Whole turns first, then along the null space of the Jacobian, each step followed by a descent.
    """
    turns = np.rint((wanted_rad - found.joints_rad) / _TURN)
    turned = found.joints_rad + _TURN * turns
    inside = (turned >= robot.lower_rad) & (turned <= robot.upper_rad)
    joints = np.where(inside, turned, found.joints_rad)
    best = _descend(robot, T_base_tcp, joints)
    if not best.reached:
        return found
    if len(joints) <= NUM_POSE:
        return best
    for _ in range(_TOWARDS):
        q = robot.configuration(best.joints_rad)
        pin.computeJointJacobians(robot.model, robot.data, q)
        pin.updateFramePlacement(robot.model, robot.data, robot.tcp_id)
        full = pin.getFrameJacobian(robot.model, robot.data, robot.tcp_id, pin.LOCAL)
        jacobian = full[:, robot.arm_velocity_ids]
        away = wanted_rad - best.joints_rad
        step = away - np.linalg.pinv(jacobian, rcond=1e-4) @ (jacobian @ away)
        size = float(np.abs(step).max())
        if size < _SETTLED_RAD:
            break
        step *= min(1.0, _STEP_RAD / size)
        other = _descend(robot, T_base_tcp, best.joints_rad + step)
        closer = np.linalg.norm(wanted_rad - other.joints_rad) < np.linalg.norm(away)
        if not (other.reached and closer):
            break
        best = other
    return best


def _descend(
    robot: RobotModel, T_base_tcp: Pose, start_rad: Joints, turn_weight: float | None = None
) -> IkSolution:
    """One descent. Calls into pinocchio take a microsecond each, so each is made once a step.

    Joints that a limit stops are left out: the others then do their part. With a ``turn_weight``
    position and orientation count apart, so that one may be left.
    """
    model, data, tcp_id = robot.model, robot.data, robot.tcp_id
    lower, upper, arm = robot.lower_rad, robot.upper_rad, robot.arm_ids
    target = pin.SE3(T_base_tcp)
    joints = np.minimum(np.maximum(start_rad, lower), upper)
    q = robot.configuration(joints)
    damping, last = 1e-6, math.inf
    accepted, misses = joints, target
    jacobian, error = np.zeros((6, len(joints))), np.zeros(6)
    for _ in range(MAX_ITERATIONS):
        q[arm] = joints
        pin.computeJointJacobians(model, data, q)
        difference = pin.updateFramePlacement(model, data, tcp_id).actInv(target)
        if turn_weight is None:
            trial = pin.log6(difference).vector
        else:
            turn = turn_weight * pin.log3(difference.rotation)
            trial = np.concatenate([difference.translation, turn])
        norm = math.sqrt(trial @ trial)
        if norm < last:
            accepted, last, error, misses = joints, norm, trial, difference
            if norm < _CONVERGED:
                break
            damping = max(damping * 0.2, 1e-9)
            full = pin.getFrameJacobian(model, data, tcp_id, pin.LOCAL)
            jacobian = full[:, robot.arm_velocity_ids]
            if turn_weight is not None:
                jacobian = jacobian * np.repeat((1.0, turn_weight), 3)[:, None]
            pull = jacobian.T @ trial
            stopped = ((joints <= lower) & (pull < 0)) | ((joints >= upper) & (pull > 0))
            jacobian = np.where(stopped, 0.0, jacobian)
        else:
            damping *= 10.0
            if not damping < _MAX_DAMPING:
                break
        square = jacobian @ jacobian.T
        square.flat[::7] += damping
        weights = dposv(square, error)[1]
        joints = np.minimum(np.maximum(accepted + jacobian.T @ weights, lower), upper)
    position, rotation = math.hypot(*misses.translation), math.hypot(*pin.log3(misses.rotation))
    return IkSolution(
        joints_rad=accepted,
        position_error_m=position,
        rotation_error_rad=rotation,
        reached=last < math.inf  # nothing was tried of a pose that is no number
        and position <= POSITION_TOLERANCE_M
        and rotation <= ROTATION_TOLERANCE_RAD,
    )


# Whether an arm has the geometry of a UR: its joint axes at zero decide, not its link frames. A
# Denavit-Hartenberg chain is laid through them and must then reproduce pinocchio's kinematics.

_SAME_DIRECTION = 1e-4
_SHORTEST_M = 1e-4
_WORST = 1e-5
"""Deviation from pinocchio [m and rad] up to which an arm counts as one; rpy="1.5708" is 4e-6."""
_NUM_CHECKS = 12

_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)


@dataclass(frozen=True, kw_only=True)
class UrGeometry:
    """Lengths and fixed frames; d1 is part of ``T_base_0`` and d6 of ``T_6_tcp``."""

    a2_m: float
    """Upper arm."""
    a3_m: float
    """Forearm."""
    d4_m: float
    """How far the wrist stands beside the plane that holds the first axis."""
    d5_m: float
    """From the fourth axis to the sixth."""
    signs: Float[np.ndarray, "6"]
    offsets_rad: Float[np.ndarray, "6"]
    """theta = signs * joints + offsets."""
    T_base_0: Pose
    """First axis along z; the origin is where the first two axes meet."""
    T_6_tcp: Pose
    """Sixth axis along z; the origin is where the last two axes meet."""
    deviation: float = 0.0
    """Largest entry of the difference to pinocchio's poses over random postures."""

    def forward(self, joints_rad: Float[np.ndarray, "6"]) -> Pose:
        """Pose ``T_base_tcp`` of one posture."""
        theta = self.signs * joints_rad + self.offsets_rad
        a = (0.0, self.a2_m, self.a3_m, 0.0, 0.0, 0.0)
        d = (0.0, 0.0, 0.0, self.d4_m, self.d5_m, 0.0)
        T = self.T_base_0
        for row in zip(theta, a, d, _ALPHA, strict=True):
            T = T @ _link(*row)
        return np.asarray(T @ self.T_6_tcp)


def _axes(robot: RobotModel) -> tuple[Float[np.ndarray, "6 3"], Float[np.ndarray, "6 3"]] | None:
    """Direction of each joint axis at zero and the point on it nearest the base's origin."""
    if len(robot.arm_ids) != 6:
        return None
    q = robot.configuration(np.zeros(6))
    twists = np.array(pin.computeJointJacobians(robot.model, robot.model.createData(), q))
    twists = twists[:, robot.arm_velocity_ids].T
    directions = twists[:, 3:]
    if not np.allclose(np.linalg.norm(directions, axis=1), 1.0):
        return None
    return directions, np.cross(directions, twists[:, :3])


def _through(
    w: Float[np.ndarray, "6 3"], p: Float[np.ndarray, "6 3"], T_base_tcp: Pose
) -> UrGeometry | None:
    """Lay the chain through the axes; None when they do not stand to each other as a UR's do."""
    across = [w[0] @ w[1], w[3] @ w[4], w[4] @ w[5]]
    along = [np.linalg.norm(np.cross(w[1], w[2])), np.linalg.norm(np.cross(w[1], w[3]))]
    if np.abs([*across, *along]).max() > _SAME_DIRECTION:
        return None
    origin = _meeting(p[0], w[0], p[1], w[1])
    x1, y1, z1 = np.cross(w[0], w[1]), w[0], w[1]
    elbow, wrist = ((point - origin) @ np.stack([x1, y1], axis=1) for point in (p[2], p[3]))
    fore = wrist - elbow
    a2, a3 = float(np.hypot(*elbow)), float(np.hypot(*fore))
    if min(a2, a3) < _SHORTEST_M:
        return None
    wrist_45, wrist_56 = _meeting(p[3], w[3], p[4], w[4]), _meeting(p[4], w[4], p[5], w[5])
    upper_rad, fore_rad = (float(np.arctan2(v[1], v[0])) for v in (elbow, fore))
    turned_rad = float(np.arctan2(w[4] @ x1, -w[4] @ y1))
    x4 = np.cos(turned_rad) * x1 + np.sin(turned_rad) * y1
    bent_rad = float(np.arctan2(-w[5] @ x4, w[5] @ z1))
    T_base_0 = se3.from_rotation(np.stack([x1, -z1, w[0]], axis=1), origin)
    chain = UrGeometry(
        a2_m=a2,
        a3_m=a3,
        d4_m=float((wrist_45 - origin) @ z1),
        d5_m=float((wrist_56 - wrist_45) @ w[4]),
        signs=np.array([1.0, 1.0, np.sign(w[2] @ z1), np.sign(w[3] @ z1), 1.0, 1.0]),
        offsets_rad=np.array(
            [0.0, upper_rad, fore_rad - upper_rad, turned_rad - fore_rad, bent_rad, 0.0]
        ),
        T_base_0=T_base_0,
        T_6_tcp=np.eye(4),
    )
    T_6_tcp = np.linalg.solve(chain.forward(np.zeros(6)), T_base_tcp)
    return replace(chain, T_6_tcp=T_6_tcp)


def _meeting(
    p: Float[np.ndarray, "3"],
    v: Float[np.ndarray, "3"],
    q: Float[np.ndarray, "3"],
    w: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3"]:
    """Where two lines that are square to each other meet: the point of the first one."""
    along = np.linalg.solve(np.stack([v, -w, np.cross(v, w)], axis=1), q - p)[0]
    return np.asarray(p + along * v)


def _link(theta: float, a_m: float, d_m: float, alpha: float) -> Pose:
    """Rotate about z, move along z, move along the new x, rotate about it."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [
            [c, -s * ca, s * sa, a_m * c],
            [s, c * ca, -c * sa, a_m * s],
            [0.0, sa, ca, d_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


# The closed form for UR-type arms (Hawkins 2013, "Analytic inverse kinematics for the Universal
# Robots UR-5/UR-10 arms"): n, the direction of the second to fourth axis, with n . wrist = d4 has
# two shoulders; n seen from the tool gives two wrists, and with them the fifth axis; what is left
# is a planar arm with two elbows. Arctangents take what stays exact near the singularities.

NUM_BRANCHES = 8
"""Branch number: 4 * shoulder + 2 * wrist + elbow, each 0 or 1."""
_BEYOND, _BEYOND_PER_M = 1e-9, 100.0
"""A cosine may leave [-1, 1] by this: a stretched arm, reached to a fraction of a nanometre; and by
so much more per metre by which the closed form misses the description."""
_SINGULAR = 1e-9
"""Sine of the fifth joint below which the sixth may be anything."""
_LIMIT_SLACK_RAD = 1e-9

_TURN = 2 * np.pi


@dataclass(frozen=True)
class UrInverse:
    """All joints of a UR-type arm that reach a pose."""

    geometry: UrGeometry
    lower_rad: Float[np.ndarray, "6"]
    upper_rad: Float[np.ndarray, "6"]

    @staticmethod
    @lru_cache(maxsize=4)
    def for_robot(robot: RobotModel) -> "UrInverse | None":
        """Return the inverse of a robot's arm, None when its geometry is not that of a UR."""
        axes = _axes(robot)
        laid = None if axes is None else _through(*axes, robot.T_base_tcp(np.zeros(6)))
        if laid is None:
            return None
        rows = np.random.default_rng(0).uniform(-np.pi, np.pi, (_NUM_CHECKS, 6))
        worst = max(float(np.abs(laid.forward(q) - robot.T_base_tcp(q)).max()) for q in rows)
        if not worst < _WORST:
            return None
        return UrInverse(replace(laid, deviation=worst), robot.lower_rad, robot.upper_rad)

    def solve(
        self, Ts_base_tcp: Float[np.ndarray, "num_poses 4 4"]
    ) -> tuple[
        Float[np.ndarray, "num_poses 8 6"],
        Bool[np.ndarray, "num_poses 8"],
        Bool[np.ndarray, " num_poses"],
    ]:
        """Joints [rad] on all branches within one turn and the limits; which are solutions.

        The last says where some branch has a straight wrist: in reach too, by joints that nobody
        can number. Out of reach or limits, not a number, or a joint that may be anything: all 0.
        """
        finite = np.isfinite(Ts_base_tcp).all(axis=(1, 2))
        theta, valid, singular = _angles(
            self.geometry, np.where(finite[:, None, None], Ts_base_tcp, 0.0)
        )
        joints = (theta - self.geometry.offsets_rad) * self.geometry.signs
        joints -= _TURN * np.rint(joints / _TURN)
        joints += _TURN * (joints < self.lower_rad - _LIMIT_SLACK_RAD)
        joints -= _TURN * (joints > self.upper_rad + _LIMIT_SLACK_RAD)
        inside = (joints >= self.lower_rad - _LIMIT_SLACK_RAD) & (
            joints <= self.upper_rad + _LIMIT_SLACK_RAD
        )
        valid &= inside.all(axis=2) & finite[:, None]
        return np.where(valid[..., None], joints, 0.0), valid, singular & finite


def _angles(
    geometry: UrGeometry, Ts_base_tcp: Float[np.ndarray, "num_poses 4 4"]
) -> tuple[
    Float[np.ndarray, "num_poses 8 6"],
    Bool[np.ndarray, "num_poses 8"],
    Bool[np.ndarray, " num_poses"],
]:
    """Angles of the Denavit-Hartenberg chain; axes of the arrays: pose, shoulder, wrist, elbow."""
    g = geometry
    beyond = _BEYOND + (_BEYOND_PER_M * g.deviation if g.deviation > _BEYOND else 0.0)
    T = se3.invert(g.T_base_0) @ Ts_base_tcp @ se3.invert(g.T_6_tcp)
    R = T[:, :3, :3]
    x, y, z = (T[:, i, 3, None] for i in range(3))
    theta = np.empty((len(T), 2, 2, 2, 6))

    radius = np.hypot(x, y)
    sine = np.divide(g.d4_m, radius, out=np.full_like(radius, 2.0), where=radius > _SINGULAR)
    valid = (np.abs(sine) <= 1 + beyond)[..., None, None]
    lean = np.arcsin(np.clip(sine, -1.0, 1.0))
    first = np.arctan2(y, x) + np.concatenate([lean, np.pi - lean], axis=1)
    c1, s1 = np.cos(first), np.sin(first)
    theta[..., 0] = first[..., None, None]

    # n, the direction of the parallel axes, in the frame of the tool: (s5 c6, -s5 s6, c5).
    nx, ny, nz = (R[:, 0, k, None] * s1 - R[:, 1, k, None] * c1 for k in range(3))
    s5 = np.hypot(nx, ny)
    safe = np.maximum(s5, _SINGULAR)
    wrist = np.array([1.0, -1.0])
    theta[..., 4] = np.arctan2(s5[..., None] * wrist, nz[..., None])[..., None]
    sixth = np.arctan2(-ny, nx)
    theta[..., 5] = (sixth[..., None] + np.array([0.0, np.pi]))[..., None]
    singular = (s5 <= _SINGULAR) & valid[..., 0, 0]
    valid = valid & (s5 > _SINGULAR)[..., None, None]

    # The fifth axis, in the plane of the arm.
    c6, s6 = nx / safe, -ny / safe
    across = -s6 * (R[:, 0, 0, None] * c1 + R[:, 1, 0, None] * s1) - c6 * (
        R[:, 0, 1, None] * c1 + R[:, 1, 1, None] * s1
    )
    up = -s6 * R[:, 2, 0, None] - c6 * R[:, 2, 1, None]
    across, up = across[..., None] * wrist, up[..., None] * wrist

    px = (x * c1 + y * s1)[..., None] - g.d5_m * across
    py = z[..., None] - g.d5_m * up
    c3 = (px**2 + py**2 - g.a2_m**2 - g.a3_m**2) / (2 * g.a2_m * g.a3_m)
    valid = valid & ((np.abs(c3) <= 1 + beyond) & (np.hypot(px, py) > _SINGULAR))[..., None]
    c3 = np.clip(c3, -1.0, 1.0)
    s3 = np.sqrt((1.0 - c3) * (1.0 + c3))
    elbow = np.array([1.0, -1.0])
    third = np.arctan2(s3, c3)[..., None] * elbow
    inner = np.arctan2(g.a3_m * s3, g.a2_m + g.a3_m * c3)[..., None] * elbow
    theta[..., 2] = third
    theta[..., 1] = np.arctan2(py, px)[..., None] - inner
    theta[..., 3] = np.arctan2(across, -up)[..., None] - theta[..., 1] - third
    shape = (len(T), NUM_BRANCHES)
    everywhere = np.broadcast_to(valid, theta.shape[:-1]).reshape(shape)
    return theta.reshape(*shape, 6), everywhere.copy(), singular.any(axis=1)
