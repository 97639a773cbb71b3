"""AX = ZB from noisy pose pairs: refined, robust, with intervals, or refused with a reason.

See ``closed_form`` for what A, B, X and Z are. The misfit of a pair is E = (Z B)^-1 A X: what is
left between the two ways to the same frame. It does not change with the choice of base frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.calibrate.closed_form import motions, solve_hand_eye, solve_robot_world
from twin.errors import TwinError

MIN_PAIRS = 4
"""Three determine both unknowns and leave nothing to judge them by."""
MIN_TURN_RAD = 0.05
"""Root mean square turn about the second axis of rotation, below which one axis is all there is."""
OUTLIER = 5.0
"""Misfits far beyond this many standard deviations lose their say (Geman and McClure's loss)."""
REFUSED_WEIGHT = 0.05
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

    Starts from the better of two closed forms, minimises Geman and McClure's loss of the misfits
    by Gauss-Newton, and repeats that on resampled pairs for the intervals.

    Args:
        Ts_a: Poses from the robot.
        Ts_b: Poses from the camera; see ``closed_form``.
        seed: Of the resampling.

    Raises:
        UndeterminedCameraError: Too few pairs, or rotations about one axis only.
    """
    turn = check_motions(Ts_a)
    X, Z = _refined(Ts_a, Ts_b, *_start(Ts_a, Ts_b), iterations=30)
    scales = _scales(misfits(Ts_a, Ts_b, X, Z))
    distance, angle = _lengths(misfits(Ts_a, Ts_b, X, Z))
    outliers = int((_weights(misfits(Ts_a, Ts_b, X, Z), scales) < REFUSED_WEIGHT).sum())
    rng = np.random.default_rng(seed)
    medians, xs = [], []
    for _ in range(NUM_RESAMPLES):
        ids = rng.integers(len(Ts_a), size=len(Ts_a))
        X_again, _ = _refined(Ts_a[ids], Ts_b[ids], X, Z, iterations=4, scales=scales)
        medians.append([float(np.median(v[ids])) for v in (distance, angle)])
        xs.append(X_again)
    low, high = np.quantile(medians, [0.025, 0.975], axis=0)
    change = se3.invert(X) @ np.array(xs)
    return RobotWorld(
        X=X,
        Z=Z,
        num_pairs=len(Ts_a),
        num_outliers=outliers,
        residual_m=_interval(distance, low[0], high[0]),
        residual_rad=_interval(angle, low[1], high[1]),
        x_sigma_m=_spread(change[:, :3, 3]),
        x_sigma_rad=_spread(se3.vector_from_rotation(change[:, :3, :3])),
        second_turn_rad=turn,
    )


def check_motions(Ts_a: Float[np.ndarray, "num_pairs 4 4"]) -> float:
    """Return the root mean square turn about the second axis of all motions [rad].

    Raises:
        UndeterminedCameraError: Too few poses, or rotations about one axis only.
    """
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
    """Translation [m] and rotation vector [rad] of E = (Z B)^-1 A X for each pair."""
    E = se3.invert(Z @ Ts_b) @ Ts_a @ X
    return np.concatenate([E[:, :3, 3], se3.vector_from_rotation(E[:, :3, :3])], axis=1)


def _start(Ts_a: np.ndarray, Ts_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closed form with the smaller median misfit; neither is best on all data."""
    X = solve_hand_eye(Ts_a, Ts_b)
    candidates = [(X, _middle(Ts_a @ X @ se3.invert(Ts_b))), solve_robot_world(Ts_a, Ts_b)]
    costs = [np.median(_lengths(misfits(Ts_a, Ts_b, *found))[0]) for found in candidates]
    return candidates[int(np.argmin(costs))]


def _middle(Ts: Float[np.ndarray, "num_pairs 4 4"]) -> Float[np.ndarray, "4 4"]:
    """The one of several estimates of a pose that lies nearest to all others."""
    gap = np.linalg.norm(Ts[:, None, :3, 3] - Ts[None, :, :3, 3], axis=-1)
    return np.asarray(Ts[int(np.argmin(np.median(gap, axis=1)))])


def _refined(
    Ts_a: np.ndarray,
    Ts_b: np.ndarray,
    X: np.ndarray,
    Z: np.ndarray,
    *,
    iterations: int,
    scales: tuple[float, float] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    for _ in range(iterations):
        r = misfits(Ts_a, Ts_b, X, Z)
        used = _scales(r) if scales is None else scales
        inverse = np.repeat(1.0 / np.array(used), 3)
        J = _jacobian(Ts_b, Z, r) * inverse[:, None]
        weighted = J * _weights(r, used)[:, None, None]
        H = np.einsum("nij,nik->jk", weighted, J)
        g = np.einsum("nij,ni->j", weighted, r * inverse)
        step, *_ = np.linalg.lstsq(H, -g, rcond=1e-12)
        X, Z = X @ _moved(step[:6]), Z @ _moved(step[6:])
        if np.abs(step).max() < 1e-11:
            break
    return X, Z


def _jacobian(
    Ts_b: np.ndarray, Z: np.ndarray, r: np.ndarray
) -> Float[np.ndarray, "num_pairs 6 12"]:
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
