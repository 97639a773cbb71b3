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
from scipy.optimize import least_squares

from bridge.geometry import se3
from twin.calibrate.config import Mount
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


def solve_motions(
    P: Float[np.ndarray, "num_motions 4 4"],
    Q: Float[np.ndarray, "num_motions 4 4"],
    *,
    scaled: bool = False,
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Solve PX = XQ for X, where ``scaled`` with a factor of the translations of Q, else 1.

    Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group" (1994):
    the rotation that lays the rotation vectors of Q over those of P, then linear least squares
    for the translation. The rotation is found by singular values, which unlike their square root
    of a matrix also refuses mirror images.
    """
    alpha, beta = se3.vector_from_rotation(P[:, :3, :3]), se3.vector_from_rotation(Q[:, :3, :3])
    clear = np.linalg.norm(alpha, axis=1) < HALF_TURN_RAD
    clear &= np.linalg.norm(beta, axis=1) < HALF_TURN_RAD
    if clear.sum() < 2:
        clear[:] = True
    R = se3.nearest_rotation(alpha[clear].T @ beta[clear])
    seen = Q[:, :3, 3] @ R.T
    left = np.concatenate([P[:, :3, :3] - np.eye(3), -scaled * seen[:, :, None]], axis=2)
    x, *_ = np.linalg.lstsq(left.reshape(-1, 4), (seen - P[:, :3, 3]).reshape(-1), rcond=None)
    return se3.from_rotation(R, x[:3]), 1.0 + float(x[3])


MIN_PAIRS = 4
"""Three determine both unknowns and leave nothing to judge them by."""
MIN_TURN_RAD = 0.05
"""Root mean square turn about the second axis of rotation, below which one axis is all there is."""
OUTLIER_SQUARE = 87.0
"""Pairs whose misfits in standard deviations have a larger sum of squares contradict the others."""
ROUNDS = 5
"""Fits, each with the scales of the misfits that the one before left."""
MEDIAN_OF_THREE = 1.538
"""Median length of three standard normal numbers."""
FLOOR = 1e-7
"""Metres and radians: exact data have misfits of rounding only."""


class UndeterminedCameraError(TwinError):
    """The recorded poses do not determine where the camera is."""


@dataclass(frozen=True, kw_only=True)
class RobotWorld:
    """X and Z of one camera, and how well they are known."""

    X: Float[np.ndarray, "4 4"]
    Z: Float[np.ndarray, "4 4"]
    num_pairs: int
    num_outliers: int
    """Pairs that had no say because they contradict the others."""
    residual_m: float
    """Median over pairs of the distance between the two ways to the camera or target."""
    residual_rad: float
    """The same for the angle."""
    sigma_m: float
    """Standard deviation of the position of X, all axes together."""


def solve(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"], Ts_b: Float[np.ndarray, "num_pairs 4 4"]
) -> RobotWorld:
    """Find X and Z with A X = Z B: from the closed form on, by Cauchy's loss of the misfits.

    UndeterminedCameraError for too few pairs, and for rotations about one axis only.
    """
    check_motions(Ts_a)
    X, _ = solve_motions(*motions(Ts_a, Ts_b))
    each, J = Ts_a @ X @ se3.invert(Ts_b), np.zeros((0, 12))
    gaps = np.linalg.norm(each[:, None, :3, 3] - each[None, :, :3, 3], axis=-1)
    Z = each[int(np.argmin(np.median(gaps, axis=1)))]  # the one nearest to all others
    for _ in range(ROUNDS):
        X, Z, J = _refined(Ts_a, Ts_b, X, Z)
    left = misfits(Ts_a, Ts_b, X, Z)
    distance, angle = _lengths(left)
    far = np.square(np.stack([distance, angle], axis=1) / _scales(left)).sum(axis=1)
    variance = np.diag(np.linalg.pinv(J.T @ J))
    return RobotWorld(
        X=X,
        Z=Z,
        num_pairs=len(Ts_a),
        num_outliers=int((far > OUTLIER_SQUARE).sum()),
        residual_m=float(np.median(distance)),
        residual_rad=float(np.median(angle)),
        sigma_m=float(np.sqrt(variance[3:6].sum())),
    )


def check_motions(Ts_a: Float[np.ndarray, "num_pairs 4 4"]) -> None:
    """Refuse poses too few, or turned about one axis alone, to say where a camera is."""
    if len(Ts_a) < MIN_PAIRS:
        raise UndeterminedCameraError(
            f"{len(Ts_a)} pair(s) of poses do not determine a camera; at least {MIN_PAIRS} are "
            "needed, 10 to 20 are good. Record the target from more places."
        )
    P, _ = motions(Ts_a, Ts_a)
    turns = se3.vector_from_rotation(P[:, :3, :3])
    sizes = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if sizes[1] < MIN_TURN_RAD:
        found = "does not turn at all" if sizes[0] < MIN_TURN_RAD else "turns about one axis only"
        raise UndeterminedCameraError(
            f"over {len(Ts_a)} poses the hand {found} ({np.degrees(sizes[1]):.1f} degrees about "
            f"any second axis, {np.degrees(MIN_TURN_RAD):.0f} are needed): the camera's position "
            "is not determined. Tilt the tool about two different axes, 20 degrees or more."
        )


def misfits(
    Ts_a: Float[np.ndarray, "num_pairs 4 4"],
    Ts_b: Float[np.ndarray, "num_pairs 4 4"],
    X: Float[np.ndarray, "4 4"],
    Z: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "num_pairs 6"]:
    """Translation [m] and rotation vector [rad] of E = (Z B)^-1 A X for each pair."""
    E = se3.invert(Z @ Ts_b) @ Ts_a @ X
    return np.concatenate([E[:, :3, 3], se3.vector_from_rotation(E[:, :3, :3])], axis=1)


def _refined(
    Ts_a: np.ndarray, Ts_b: np.ndarray, X: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "num_residuals 12"]]:
    """X, Z and the derivatives of the misfits, in units of their standard deviations."""
    inverse = np.repeat(1.0 / _scales(misfits(Ts_a, Ts_b, X, Z)), 3)

    def left(step: Float[np.ndarray, "12"]) -> Float[np.ndarray, " num_residuals"]:
        moved = X @ se3.small_motion(step[:6]), Z @ se3.small_motion(step[6:])
        return np.asarray((misfits(Ts_a, Ts_b, *moved) * inverse).ravel())

    exact = {"ftol": 1e-13, "xtol": 1e-13, "gtol": 1e-13}
    fit = least_squares(left, np.zeros(12), jac="3-point", loss="cauchy", **exact)
    return X @ se3.small_motion(fit.x[:6]), Z @ se3.small_motion(fit.x[6:]), fit.jac


def _lengths(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.linalg.norm(r[:, :3], axis=1), np.linalg.norm(r[:, 3:], axis=1)


def _scales(r: np.ndarray) -> Float[np.ndarray, "2"]:
    """Standard deviation per axis of translation and rotation, from medians."""
    return np.asarray(np.maximum(np.median(_lengths(r), axis=1) / MEDIAN_OF_THREE, FLOOR))


CLEARLY = 3.0
"""One explanation of the pairs beats the other when its misfit is this many times smaller."""
MAX_RESIDUAL_M = 0.02
MAX_RESIDUAL_RAD = 0.05
"""Pairs that disagree by more belong to no one mounting."""


@dataclass(frozen=True, kw_only=True)
class PosePairs:
    """What robot and camera said at the same instants."""

    Ts_base_effector: Float[np.ndarray, "num_pairs 4 4"]
    Ts_camera_target: Float[np.ndarray, "num_pairs 4 4"]
    source: str
    """Episode ids."""


def find_camera(pairs: PosePairs, mount: Mount) -> tuple[RobotWorld, Mount]:
    """Find a camera from pose pairs, and its mounting; ``auto`` takes what fits clearly better.

    With the camera in the hand X is ``T_effector_camera`` and Z is ``T_base_target``; with a fixed
    camera X is ``T_effector_target`` and Z is ``T_base_camera``. UndeterminedCameraError also where
    pairs fit neither mounting, or the other one than was asked for.
    """
    seen = pairs.Ts_camera_target
    each: dict[Mount, np.ndarray] = {"hand": se3.invert(seen), "fixed": seen}
    found = {name: solve(pairs.Ts_base_effector, Ts) for name, Ts in each.items()}
    size = {name: item.residual_m for name, item in found.items()}
    best, other = sorted(each, key=lambda name: size[name])
    if mount == "auto" and size[other] < CLEARLY * size[best]:
        raise UndeterminedCameraError(
            f"the {len(seen)} pose pairs of {pairs.source} fit a camera in the hand to "
            f"{size['hand'] * 1e3:.1f} mm and a fixed one to {size['fixed'] * 1e3:.1f} mm, which "
            "does not tell them apart. Say which: --mount hand or --mount fixed."
        )
    chosen = best if mount == "auto" else mount
    if chosen != best and size[chosen] > CLEARLY * size[best]:
        raise UndeterminedCameraError(
            f"the pose pairs of {pairs.source} miss a camera mounted {chosen!r} by "
            f"{size[chosen] * 1e3:.1f} mm and fit {best!r} to {size[best] * 1e3:.1f} mm. Say "
            f"--mount {best}, or invert the target poses: T_camera_target is wanted."
        )
    metres, turn = size[chosen], found[chosen].residual_rad
    if metres > MAX_RESIDUAL_M or turn > MAX_RESIDUAL_RAD:
        raise UndeterminedCameraError(
            f"the pose pairs of {pairs.source} disagree by {metres * 1e3:.0f} mm and "
            f"{turn * 57.3:.1f} degrees (median): they come from different instants, another link "
            "or a target that moved. Check --link, and that robot and target stood still."
        )
    return found[chosen], chosen
