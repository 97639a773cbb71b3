"""Hand-eye calibration: AX = ZB from noisy pose pairs, with intervals, or refused with a reason.

With a camera in the hand, A is ``T_base_hand``, B is ``T_target_camera``, X is ``T_hand_camera``
and Z is ``T_base_target``. With a fixed camera and the target in the hand, B is
``T_camera_target``, X is ``T_hand_target`` and Z is ``T_base_camera``. A closed form gives the
start; a robust least squares refines it. The misfit of a pair is E = (Z B)^-1 A X: what is left
between the two ways to the same frame. It does not change with the choice of base frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.calibrate.config import Mount
from twin.calibrate.pairs import PosePairs
from twin.errors import TwinError

MAX_MOTIONS = 2000
"""Motions between pairs of poses that are used; more change nothing but the time."""
HALF_TURN_RAD = 3.0
"""Above this angle noise may flip the axis of a motion."""


def motions(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"], Ts_b: Float[np.ndarray, "num_pairs 4 4"]
) -> tuple[Float[np.ndarray, "num_motions 4 4"], Float[np.ndarray, "num_motions 4 4"]]:
    """Motions P and Q between pairs of poses, for which P X = X Q.

    From A_i X = Z B_i for two poses: P = A_j^-1 A_i and Q = B_j^-1 B_i.
    """
    first, second = np.triu_indices(len(Ts_a), 1)
    if len(first) > MAX_MOTIONS:
        kept = np.unique(np.linspace(0, len(first) - 1, MAX_MOTIONS).astype(int))
        first, second = first[kept], second[kept]
    P = se3.invert(Ts_a)[second] @ Ts_a[first]
    Q = se3.invert(Ts_b)[second] @ Ts_b[first]
    return P, Q


def solve_hand_eye(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"], Ts_b: Float[np.ndarray, "num_pairs 4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Solve AX = XB for X from the motions between all poses.

    Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group" (1994):
    the rotation that lays the rotation vectors of Q over those of P, then linear least squares
    for the translation. The rotation is found by singular values, which unlike their square root
    of a matrix also refuses mirror images.
    """
    P, Q = motions(Ts_a, Ts_b)
    alpha, beta = se3.vector_from_rotation(P[:, :3, :3]), se3.vector_from_rotation(Q[:, :3, :3])
    clear = np.linalg.norm(alpha, axis=1) < HALF_TURN_RAD
    clear &= np.linalg.norm(beta, axis=1) < HALF_TURN_RAD
    if clear.sum() < 2:
        clear[:] = True
    R = se3.nearest_rotation(alpha[clear].T @ beta[clear])
    left = P[:, :3, :3] - np.eye(3)
    right = Q[:, :3, 3] @ R.T - P[:, :3, 3]
    t, *_ = np.linalg.lstsq(left.reshape(-1, 3), right.reshape(-1), rcond=None)
    return _transform(R, t)


def _transform(R: Float[np.ndarray, "3 3"], t_m: Float[np.ndarray, "3"]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t_m
    return T


MIN_PAIRS = 4
"""Three determine both unknowns and leave nothing to judge them by."""
MIN_TURN_RAD = 0.05
"""Root mean square turn about the second axis of rotation, below which one axis is all there is."""
OUTLIER = 5.0
"""Misfits far beyond this many standard deviations lose their say (Geman and McClure's loss)."""
REFUSED_WEIGHT = 0.05
RESCALED = 8
"""Iterations after which the scales of the misfits stay, so that the others converge."""
NUM_RESAMPLES = 200
MEDIAN_OF_THREE = 1.538
"""Median length of three standard normal numbers."""
FLOOR = 1e-7
"""Metres and radians: exact data have misfits of rounding only."""


class UndeterminedCameraError(TwinError):
    """The recorded poses do not determine where the camera is."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A number with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float

    def to_record(self) -> dict[str, float]:
        """Return plain numbers."""
        return {"value": self.value, "low": self.low, "high": self.high}


@dataclass(frozen=True, kw_only=True)
class RobotWorld:
    """X and Z of one camera, and how well they are known."""

    X: Float[np.ndarray, "4 4"]
    Z: Float[np.ndarray, "4 4"]
    num_pairs: int
    num_outliers: int
    """Pairs that had no say because they contradict the others."""
    residual_m: Interval
    """Median over pairs of the distance between the two ways to the camera or target."""
    residual_rad: Interval
    """The same for the angle."""
    x_sigma_m: float
    """Standard deviation of the position of X over bootstrap resamples, all axes together."""
    x_sigma_rad: float
    second_turn_rad: float
    """Root mean square turn about the second axis; what determines the translation of X."""


def solve(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"],
    Ts_b: Float[np.ndarray, "num_pairs 4 4"],
    *,
    seed: int = 0,
) -> RobotWorld:
    """Find X and Z with A X = Z B.

    Starts from the closed form and minimises Geman and McClure's loss of the
    misfits by Gauss-Newton. Intervals come from resampled pairs (Efron, 1979), each solved by one
    more step.

    Raises:
        UndeterminedCameraError: Too few pairs, or rotations about one axis only.
    """
    turn = check_motions(Ts_a)
    X, Z = _refined(Ts_a, Ts_b, *_start(Ts_a, Ts_b), iterations=30)
    scales = _scales(misfits(Ts_a, Ts_b, X, Z))
    distance, angle = _lengths(misfits(Ts_a, Ts_b, X, Z))
    outliers = int((_weights(misfits(Ts_a, Ts_b, X, Z), scales) < REFUSED_WEIGHT).sum())
    drawn = np.random.default_rng(seed).integers(len(Ts_a), size=(NUM_RESAMPLES, len(Ts_a)))
    medians = np.stack([np.median(values[drawn], axis=1) for values in (distance, angle)])
    low, high = np.quantile(medians, [0.025, 0.975], axis=1)
    steps = _steps(Ts_a, Ts_b, X, Z, scales, drawn)
    return RobotWorld(
        X=X,
        Z=Z,
        num_pairs=len(Ts_a),
        num_outliers=outliers,
        residual_m=_interval(distance, low[0], high[0]),
        residual_rad=_interval(angle, low[1], high[1]),
        x_sigma_m=_spread(steps[:, :3]),
        x_sigma_rad=_spread(steps[:, 3:6]),
        second_turn_rad=turn,
    )


def check_motions(Ts_a: Float[np.ndarray, "num_pairs 4 4"]) -> float:
    """Return the root mean square turn about the second axis of all motions [rad]."""
    if len(Ts_a) < MIN_PAIRS:
        message = (
            f"{len(Ts_a)} pair(s) of poses do not determine a camera; at least {MIN_PAIRS} are "
            "needed, 10 to 20 are good. Record the target from more places."
        )
        raise UndeterminedCameraError(message)
    P, _ = motions(Ts_a, Ts_a)
    turns = se3.vector_from_rotation(P[:, :3, :3])
    sizes = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if sizes[1] < MIN_TURN_RAD:
        found = "does not turn at all" if sizes[0] < MIN_TURN_RAD else "turns about one axis only"
        message = (
            f"over {len(Ts_a)} poses the hand {found} ({np.degrees(sizes[1]):.1f} degrees about "
            f"any second axis, {np.degrees(MIN_TURN_RAD):.0f} are needed): the camera's position "
            "is not determined. Tilt the tool about two different axes, 20 degrees or more."
        )
        raise UndeterminedCameraError(message)
    return float(sizes[1])


def misfits(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"],
    Ts_b: Float[np.ndarray, "num_pairs 4 4"],
    X: Float[np.ndarray, "4 4"],
    Z: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "num_pairs 6"]:
    """Translation [m] and rotation vector [rad] of E = (Z B)^-1 A X for each pair.

    Args:
        X: The transform behind A, such as ``T_hand_camera``.
        Z: The transform before B, such as ``T_base_target``.
    """
    E = se3.invert(Z @ Ts_b) @ Ts_a @ X
    return np.concatenate([E[:, :3, 3], se3.vector_from_rotation(E[:, :3, :3])], axis=1)


def _start(Ts_a: np.ndarray, Ts_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closed form."""
    X = solve_hand_eye(Ts_a, Ts_b)
    return X, _middle(Ts_a @ X @ se3.invert(Ts_b))


def _middle(Ts: Float[np.ndarray, "num_pairs 4 4"]) -> Float[np.ndarray, "4 4"]:
    """The one of several estimates of a pose that lies nearest to all others."""
    gap = np.linalg.norm(Ts[:, None, :3, 3] - Ts[None, :, :3, 3], axis=-1)
    return np.asarray(Ts[int(np.argmin(np.median(gap, axis=1)))])


def _refined(
    Ts_a: np.ndarray, Ts_b: np.ndarray, X: np.ndarray, Z: np.ndarray, *, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    scales = (FLOOR, FLOOR)
    for iteration in range(iterations):
        if iteration < RESCALED:
            scales = _scales(misfits(Ts_a, Ts_b, X, Z))
        H, g = _equations(Ts_a, Ts_b, X, Z, scales)
        step, *_ = np.linalg.lstsq(H.sum(axis=0), -g.sum(axis=0), rcond=1e-12)
        X, Z = X @ _moved(step[:6]), Z @ _moved(step[6:])
        if np.abs(step).max() < 1e-10:
            break
    return X, Z


def _equations(
    Ts_a: np.ndarray, Ts_b: np.ndarray, X: np.ndarray, Z: np.ndarray, scales: tuple[float, float]
) -> tuple[Float[np.ndarray, "num_pairs 12 12"], Float[np.ndarray, "num_pairs 12"]]:
    """Weighted normal equations of each pair, in units of the standard deviations."""
    r = misfits(Ts_a, Ts_b, X, Z)
    inverse = np.repeat(1.0 / np.array(scales), 3)
    J = _jacobian(Ts_b, r) * inverse[:, None]
    weighted = np.swapaxes(J, 1, 2) * _weights(r, scales)[:, None, None]
    return weighted @ J, (weighted @ (r * inverse)[..., None])[..., 0]


def _steps(
    Ts_a: np.ndarray,
    Ts_b: np.ndarray,
    X: np.ndarray,
    Z: np.ndarray,
    scales: tuple[float, float],
    drawn: np.ndarray,
) -> Float[np.ndarray, "num_resamples 12"]:
    """How far each resample pulls the solution: one Gauss-Newton step of its own equations."""
    H, g = _equations(Ts_a, Ts_b, X, Z, scales)
    counts = np.stack([np.bincount(ids, minlength=len(H)) for ids in drawn]).astype(np.float64)
    left = np.einsum("sn,nij->sij", counts, H)
    # A resample of few distinct pairs may determine nothing; a thousandth of all pairs holds it.
    left += 1e-3 * H.sum(axis=0)
    return np.asarray(-np.linalg.solve(left, (counts @ g)[..., None])[..., 0])


def _jacobian(Ts_b: np.ndarray, r: np.ndarray) -> Float[np.ndarray, "num_pairs 6 12"]:
    """Derivatives of the misfits with respect to X exp(x) and Z exp(z), for small misfits."""
    J = np.zeros((len(r), 6, 12))
    R_e, R_bt = se3.rotation_from_vector(r[:, 3:]), np.swapaxes(Ts_b[:, :3, :3], 1, 2)
    J[:, :3, 0:3] = R_e
    J[:, 3:, 3:6] = np.eye(3)
    J[:, :3, 6:9] = -R_bt
    J[:, :3, 9:12] = R_bt @ _cross(Ts_b[:, :3, 3]) + _cross(r[:, :3]) @ R_bt
    J[:, 3:, 9:12] = -R_bt
    return J


def _cross(v: np.ndarray) -> np.ndarray:
    """Matrices [v]x with [v]x w = v x w."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), 2, 0)


def _moved(step: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(step[3:])
    T[:3, 3] = step[:3]
    return T


def _lengths(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.linalg.norm(r[:, :3], axis=1), np.linalg.norm(r[:, 3:], axis=1)


def _scales(r: np.ndarray) -> tuple[float, float]:
    """Standard deviation per axis of translation and rotation, from medians."""
    distance, angle = _lengths(r)
    return (
        max(float(np.median(distance)) / MEDIAN_OF_THREE, FLOOR),
        max(float(np.median(angle)) / MEDIAN_OF_THREE, FLOOR),
    )


def _weights(r: np.ndarray, scales: tuple[float, float]) -> np.ndarray:
    distance, angle = _lengths(r)
    square = (distance / scales[0]) ** 2 + (angle / scales[1]) ** 2
    return np.asarray(1.0 / (1.0 + square / OUTLIER**2) ** 2)


def _interval(values: np.ndarray, low: float, high: float) -> Interval:
    return Interval(value=float(np.median(values)), low=float(low), high=float(high))


def _spread(rows: np.ndarray) -> float:
    return float(np.sqrt(rows.var(axis=0).sum()))


CLEARLY = 3.0
"""One explanation of the pairs beats the other when its misfit is this many times smaller."""
MAX_RESIDUAL_M = 0.02
MAX_RESIDUAL_RAD = 0.05
"""Pairs that disagree by more belong to no one mounting."""


@dataclass(frozen=True, kw_only=True)
class TargetCamera:
    """What was found, and how the camera is mounted."""

    solution: RobotWorld
    mount: Mount
    """``hand`` or ``fixed``."""


def find_camera(pairs: PosePairs, mount: Mount, *, seed: int = 0) -> TargetCamera:
    """Find a camera from pose pairs; says so when the pairs belong to the other mounting.

    With the camera in the hand X is ``T_effector_camera`` and Z is ``T_base_target``; with a fixed
    camera X is ``T_effector_target`` and Z is ``T_base_camera``.

    Args:
        mount: Where the camera is said to be: ``hand``, ``fixed``, or ``auto`` to take what fits
            clearly better.

    Raises:
        UndeterminedCameraError: Too few pairs, rotations about one axis only, pairs that fit
            neither mounting, or that fit the other one than was asked for.
    """
    found = {name: _solve(pairs, name, seed) for name in ("hand", "fixed")}
    size = {name: item.solution.residual_m.value for name, item in found.items()}
    best = "hand" if size["hand"] <= size["fixed"] else "fixed"
    other = "fixed" if best == "hand" else "hand"
    if mount == "auto" and size[other] < CLEARLY * size[best]:
        message = (
            f"the {len(pairs)} pose pairs of {pairs.source} fit a camera in the hand to "
            f"{size['hand'] * 1e3:.1f} mm and a fixed one to {size['fixed'] * 1e3:.1f} mm, which "
            "does not tell them apart. Say which: --mount hand or --mount fixed."
        )
        raise UndeterminedCameraError(message)
    chosen = best if mount == "auto" else mount
    if chosen != best and size[chosen] > CLEARLY * size[best]:
        message = (
            f"the pose pairs of {pairs.source} miss a camera mounted {chosen!r} by "
            f"{size[chosen] * 1e3:.1f} mm and fit {best!r} to {size[best] * 1e3:.1f} mm. Say "
            f"--mount {best}, or invert the target poses: T_camera_target is wanted."
        )
        raise UndeterminedCameraError(message)
    return _believable(found[chosen], pairs)


def _solve(pairs: PosePairs, mount: Mount, seed: int) -> TargetCamera:
    seen = pairs.Ts_camera_target
    Ts_b = se3.invert(seen) if mount == "hand" else seen
    return TargetCamera(solution=solve(pairs.Ts_base_effector, Ts_b, seed=seed), mount=mount)


def _believable(found: TargetCamera, pairs: PosePairs) -> TargetCamera:
    metres, turn = found.solution.residual_m.value, found.solution.residual_rad.value
    if metres > MAX_RESIDUAL_M or turn > MAX_RESIDUAL_RAD:
        message = (
            f"the pose pairs of {pairs.source} disagree by {metres * 1e3:.0f} mm and "
            f"{turn * 57.3:.1f} degrees (median): they come from different instants, another link "
            "or a target that moved. Check --link, and that robot and target stood still."
        )
        raise UndeterminedCameraError(message)
    return found
