"""A stage, Eq. 7 of the paper: where the tool is best at its end.

    T* = argmin J(T),   J(T) = sum_l phi([f_l(T)]_+) + lambda_reg Omega(T)

T is the pose of the tool in SE(3); the hand's width is the grasp's to say. phi is the square of a
violation in units of its scale, and f <= 0 where a constraint is satisfied; f is tightened by a
small margin, so that the regulariser leaves an answer inside of what is allowed. States are drawn
around a nominal one, and the best of them are followed by SciPy's least squares.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from bridge.geometry import se3
from twin.plan.constrain.constraint import Constraint
from twin.plan.problem import Array, Numbers, Pose, Poses, State

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


@dataclass(frozen=True, kw_only=True)
class CostTerm:
    """One constraint in the sum."""

    name: str
    violation: Callable[[State], Array]
    """f of states at the end: ``(num_states,)``, or a column for each of its parts, in metres or
    radians; satisfied where none is above zero."""
    scale: float = LENGTH_M
    unit: str = "m"

    @staticmethod
    def of(
        constraint: Constraint, at: Callable[[State], State] = lambda state: state
    ) -> "CostTerm":
        """A compiled constraint that must hold in what a state becomes; each part counts."""
        return CostTerm(
            name=constraint.kind,
            violation=lambda state: constraint.parts(at(state)),
            scale=constraint.scale,
            unit=constraint.unit,
        )


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
    subgoal: tuple[CostTerm, ...]
    """What must hold where the stage ends; at least one."""
    width_m: float = 0.0
    Ts_base_object: Mapping[str, Pose] = field(default_factory=dict)
    """Objects that stay where they are during the stage."""
    Ts_tcp_object: Mapping[str, Pose] = field(default_factory=dict)
    """Objects that move with the tool, as it took them (errata: at the grasp instant)."""

    def violations(self, Ts: Poses) -> list[Float[np.ndarray, "_ num_parts"]]:
        """Evaluate f of every term."""
        poses = {name: np.broadcast_to(T, Ts.shape) for name, T in self.Ts_base_object.items()}
        poses |= {name: Ts @ T for name, T in self.Ts_tcp_object.items()}
        widths = np.full(len(Ts), self.width_m)
        end = State(Ts_base_object=poses, T_base_tcp=Ts, width_m=widths)
        found = [np.asarray(term.violation(end)) for term in self.subgoal]
        return [values[:, None] if values.ndim == 1 else values for values in found]

    def residuals(self, Ts: Poses) -> Float[np.ndarray, "_ num_residuals"]:
        """Return numbers whose squares add up to J, those of the regulariser last."""
        return self._residuals(Ts, self.violations(Ts))

    def _residuals(self, Ts: Poses, violations: Sequence[np.ndarray]) -> np.ndarray:
        columns = [
            np.clip(found / term.scale + MARGIN, 0.0, None)
            for term, found in zip(self.subgoal, violations, strict=True)
        ]
        nominal = self.nominal_T_base_tcp
        turn = se3.vector_from_rotation(nominal[:3, :3].T @ Ts[:, :3, :3])
        way = np.concatenate([Ts[:, :3, 3] - nominal[:3, 3], turn], axis=1) / UNITS
        return np.concatenate([*columns, way * np.sqrt(LAMBDA_REG)], axis=1)

    def judged(self, Ts: Poses) -> tuple[Float[np.ndarray, "_ num_terms"], Numbers]:
        """The greatest violation of each term, and J."""
        violations = self.violations(Ts)
        greatest = np.stack([parts.max(axis=1) for parts in violations], axis=1)
        J = np.square(self._residuals(Ts, violations)).sum(axis=1)
        return greatest, np.where(np.isfinite(J), J, np.inf)


@dataclass(frozen=True, kw_only=True)
class StageState:
    """One state that a stage may end in."""

    T_base_tcp: Pose
    cost: float
    violations: tuple[float, ...]
    """f of each term [m or rad]."""

    @property
    def is_feasible(self) -> bool:
        """Whether it satisfies every constraint."""
        return max(self.violations) <= 0


def drawn_around(T: Pose, count: int, seed: int) -> Poses:
    """Draw states around a nominal one; the first is the nominal one itself."""
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-1.0, 1.0, (count, 3)) * SPREAD_M
    shift[:, 2] = np.abs(shift[:, 2])
    about = np.zeros((count, 3))
    about[:, 2] = rng.uniform(-np.pi, np.pi, count)
    axis = rng.normal(size=(count, 3))
    turn = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    turn *= rng.uniform(0.0, SPREAD_RAD, (count, 1))
    shift[0], about[0], turn[0] = 0.0, 0.0, 0.0
    Ts = np.repeat(T[None], count, axis=0)
    Ts[:, :3, :3] = se3.rotation_from_vector(about) @ T[:3, :3] @ se3.rotation_from_vector(turn)
    Ts[:, :3, 3] += shift
    return Ts


def solve(
    problem: StageProblem, *, seed: int = 0, drawn: int = 128, followed: int = 4, steps: int = 20
) -> list[StageState]:
    """Minimise J: distinct states, those that satisfy every constraint first, then the cheapest."""
    Ts = drawn_around(problem.nominal_T_base_tcp, drawn, seed)
    _, costs = problem.judged(Ts)
    best = distinct(Ts, np.argsort(costs, kind="stable"), followed)
    Ts = np.stack([_followed(problem, T, steps) for T in Ts[list(dict.fromkeys([0, *best]))]])
    violations, costs = problem.judged(Ts)
    order = np.lexsort((costs, (violations > 0).any(axis=1)))
    return [
        StageState(
            T_base_tcp=Ts[index],
            cost=float(costs[index]),
            violations=tuple(violations[index].tolist()),
        )
        for index in distinct(Ts, order, followed)
    ]


def _followed(problem: StageProblem, T: Pose, steps: int) -> Pose:
    """Where least squares lead from a state; derivatives by differences, seven states at once."""
    around = np.vstack([np.zeros(6), np.eye(6) * _DIFFERENCE])

    def at(x: np.ndarray) -> Poses:
        return moved(np.repeat(T[None], len(x), axis=0), x * UNITS)

    def slope(x: np.ndarray) -> np.ndarray:
        r = problem.residuals(at(x + around))
        return np.asarray((r[1:] - r[0]).T / _DIFFERENCE)

    found = least_squares(
        lambda x: problem.residuals(at(x[None]))[0], np.zeros(6), jac=slope, max_nfev=steps
    )
    return np.asarray(at(found.x[None])[0])


def distinct(Ts: Poses, order: np.ndarray, most: int) -> list[int]:
    """Go through poses in an order and keep those that differ from all that are kept."""
    kept: list[int] = []
    rest = np.asarray(order, dtype=np.int64)
    while len(rest) and len(kept) < most:
        first = int(rest[0])
        kept.append(first)
        near = np.linalg.norm(Ts[rest, :3, 3] - Ts[first, :3, 3], axis=1) <= LENGTH_M
        angle = se3.rotation_angle_rad(Ts[first, :3, :3].T @ Ts[rest, :3, :3])
        near &= angle <= ANGLE_RAD
        near[0] = True
        rest = rest[~near]
    return kept
