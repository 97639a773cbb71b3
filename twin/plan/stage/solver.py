"""A stage, Eq. 7 of the paper: where the tool is best at its end.

    T* = argmin J(T),   J(T) = sum_l phi([f_l(T)]_+) + lambda_reg Omega(T)

T is the pose of the tool in SE(3); the hand's width is the grasp's to say. phi is the square of a
violation in units of its scale, and f <= 0 where a constraint is satisfied; f is tightened by a
small margin, so that the regulariser leaves an answer inside of what is allowed. States are drawn
around a nominal one, and the best of them are followed by SciPy's least squares.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from bridge.geometry import se3
from twin.plan.constrain.constraint import Constraint
from twin.plan.problem import Flags, Numbers, Pose, Poses, State

LENGTH_M = 0.01
"""Unit of lengths in the regulariser and in steps."""
ANGLE_RAD = float(np.deg2rad(10.0))
UNITS = np.array([LENGTH_M] * 3 + [ANGLE_RAD] * 3)
LAMBDA_REG = 1e-3
"""Weight of the regulariser Omega, the squared deviation from the nominal pose in units."""
MARGIN = 0.02
"""Constraints are tightened by this share of their scale."""
SPREAD_M = 0.06
"""States are drawn this far around the nominal position along each axis, never below it: what is
put down comes from above."""
SPREAD_RAD = float(np.deg2rad(12.0))
"""Most that a drawn state leans; about the vertical it may be turned in any way."""
_DIFFERENCE = 1e-4
"""Step of numeric derivatives, in units."""


def moved(T: Poses, step: Float[np.ndarray, "_ 6"]) -> Poses:
    """Poses after steps: of the position in the base frame [m], of a turn in the tool's [rad]."""
    found = T.copy()
    found[:, :3, :3] = T[:, :3, :3] @ se3.rotation_from_vector(step[:, 3:])
    found[:, :3, 3] += step[:, :3]
    return found


@dataclass(frozen=True, kw_only=True)
class StageProblem:
    """One stage as an optimisation problem; poses ``T_base_tcp`` in batches."""

    nominal_T_base_tcp: Pose
    subgoal: tuple[Constraint, ...]
    """What must hold where the stage ends; at least one."""
    width_m: float = 0.0
    Ts_base_object: Mapping[str, Pose] = field(default_factory=dict)
    """Objects that stay where they are during the stage."""
    Ts_tcp_object: Mapping[str, Pose] = field(default_factory=dict)
    """Objects that move with the tool, as it took them (errata: at the grasp instant)."""

    def state(self, Ts: Poses) -> State:
        """What is where with the tool at some poses."""
        poses = {name: np.broadcast_to(T, Ts.shape) for name, T in self.Ts_base_object.items()}
        poses |= {name: Ts @ T for name, T in self.Ts_tcp_object.items()}
        return State(Ts_base_object=poses, T_base_tcp=Ts, width_m=np.full(len(Ts), self.width_m))

    def residuals(self, Ts: Poses) -> tuple[Flags, Float[np.ndarray, "_ num_residuals"]]:
        """Whether every constraint is satisfied, and numbers whose squares add up to J."""
        state, nominal = self.state(Ts), self.nominal_T_base_tcp
        found = [(each.parts(state), each.scale) for each in self.subgoal]
        columns = [np.clip(parts / scale + MARGIN, 0.0, None) for parts, scale in found]
        turn = se3.vector_from_rotation(nominal[:3, :3].T @ Ts[:, :3, :3])
        way = np.concatenate([Ts[:, :3, 3] - nominal[:3, 3], turn], axis=1) / UNITS
        holds = np.all([(parts <= 0).all(axis=1) for parts, _ in found], axis=0)
        return holds, np.concatenate([*columns, way * np.sqrt(LAMBDA_REG)], axis=1)

    def judged(self, Ts: Poses) -> tuple[Flags, Numbers]:
        """Whether every constraint is satisfied, and J."""
        holds, residuals = self.residuals(Ts)
        J = np.square(residuals).sum(axis=1)
        return holds, np.where(np.isfinite(J), J, np.inf)


@dataclass(frozen=True, kw_only=True)
class StageState:
    """One state that a stage may end in."""

    T_base_tcp: Pose
    cost: float
    is_feasible: bool
    """Whether it satisfies every constraint."""


def perturbed(
    T_base_tcp: Pose, *, tau_p_m: float, tau_r_rad: float, count: int, rng: np.random.Generator
) -> Poses:
    """Draw end-effector poses around a nominal one, Eq. 8 and 9 of the paper.

    The position moves by a vector uniform in a box. The paper bounds the rotation vector and says
    neither how it is drawn nor in which frame; here its axis is uniform on the sphere, its angle
    uniform in [0, tau_r], and it turns the tool in the tool's own frame (errata, resolution 7).
    """
    shift = rng.uniform(-tau_p_m, tau_p_m, (count, 3))
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turn = axis * rng.uniform(0.0, tau_r_rad, (count, 1))
    return moved(np.repeat(T_base_tcp[None], count, axis=0), np.concatenate([shift, turn], axis=1))


def drawn_around(T: Pose, count: int, seed: int) -> Poses:
    """Draw states around a nominal one; the first is the nominal one itself."""
    rng = np.random.default_rng(seed)
    Ts = perturbed(T, tau_p_m=SPREAD_M, tau_r_rad=SPREAD_RAD, count=count, rng=rng)
    Ts[:, 2, 3] = T[2, 3] + np.abs(Ts[:, 2, 3] - T[2, 3])
    about = rng.uniform(-np.pi, np.pi, (count, 1)) * [0.0, 0.0, 1.0]
    Ts[:, :3, :3] = se3.rotation_from_vector(about) @ Ts[:, :3, :3]
    Ts[0] = T
    return Ts


def solve(
    problem: StageProblem, *, seed: int = 0, drawn: int = 128, followed: int = 4, steps: int = 20
) -> list[StageState]:
    """Minimise J: distinct states, those that satisfy every constraint first, then the cheapest."""
    Ts = drawn_around(problem.nominal_T_base_tcp, drawn, seed)
    _, costs = problem.judged(Ts)
    best = distinct(Ts, np.argsort(costs, kind="stable"), followed)
    Ts = np.stack([_followed(problem, T, steps) for T in Ts[list(dict.fromkeys([0, *best]))]])
    holds, costs = problem.judged(Ts)
    order = np.lexsort((costs, ~holds))
    return [
        StageState(T_base_tcp=Ts[k], cost=float(costs[k]), is_feasible=bool(holds[k]))
        for k in distinct(Ts, order, followed)
    ]


def _followed(problem: StageProblem, T: Pose, steps: int) -> Pose:
    """Where least squares lead from a state; derivatives by differences, seven states at once."""
    around = np.vstack([np.zeros(6), np.eye(6) * _DIFFERENCE])

    def at(x: np.ndarray) -> Poses:
        return moved(np.repeat(T[None], len(x), axis=0), x * UNITS)

    def slope(x: np.ndarray) -> np.ndarray:
        _, r = problem.residuals(at(x + around))
        return np.asarray((r[1:] - r[0]).T / _DIFFERENCE)

    found = least_squares(
        lambda x: problem.residuals(at(x[None]))[1][0], np.zeros(6), jac=slope, max_nfev=steps
    )
    return np.asarray(at(found.x[None])[0])


def alike(Ts: Poses, T: Pose) -> Flags:
    """Which poses are one with another, within 1 cm and 10 degrees."""
    near = np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1) <= LENGTH_M
    return np.asarray(near & (se3.rotation_angle_rad(T[:3, :3].T @ Ts[:, :3, :3]) <= ANGLE_RAD))


def distinct(Ts: Poses, order: np.ndarray, most: int) -> list[int]:
    """Go through poses in an order and keep those that differ from all that are kept."""
    kept: list[int] = []
    rest = np.asarray(order, dtype=np.int64)
    while len(rest) and len(kept) < most:
        first = int(rest[0])
        kept.append(first)
        near = alike(Ts[rest], Ts[first])
        near[0] = True
        rest = rest[~near]
    return kept
