"""Damped Gauss-Newton from many starts at once, and the distinct answers it finds.

Levenberg-Marquardt (Levenberg 1944, Marquardt 1963) on SE(3) and the width, all starts in one
batch, each with its own damping. Every state on the way that satisfies all constraints is a
candidate, not only the last one: what is left of them, after those within 1 cm and 10 degrees of
a cheaper one are dropped, are answers that differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from bridge.geometry import se3
from twin.plan.arrays import Flags, Pose, Poses
from twin.plan.stage.objective import ANGLE_RAD, LENGTH_M, NUM_VARIABLES, StageProblem, Zeta, moved

UNITS = np.array([LENGTH_M] * 3 + [ANGLE_RAD] * 3 + [LENGTH_M])
"""What a step of one is: 1 cm, 10 degrees, 1 cm."""
FREE_ITERATIONS = 12
"""Most steps of a start that go to what the constraints allow before the regulariser draws."""
SPREAD_M = 0.06
"""Starts are drawn this far around the nominal position, along each axis."""
SPREAD_TURN_RAD = float(np.pi)
DAMPING = 1e-2
LONGEST_STEP = 4.0
"""Of a start in one iteration, in units of 1 cm and 10 degrees."""
SETTLED = 1e-7
"""A start whose cost falls by a smaller share is done."""
_DIFFERENCE = 1e-4
"""Step of numeric derivatives, in units: 1 um, 0.001 degrees."""
_NOTHING = 1e-10
_NEXT_SEED = 7919
_HOPELESS = 1e6
"""A start that needs more damping than this came as far as it can."""


@dataclass(frozen=True, kw_only=True)
class SolveConfig:
    """How a stage is solved."""

    num_starts: int = 32
    iterations: int = 30
    redraws: int = 2
    """How often a start that ends where a constraint is violated is drawn anew."""
    only_above: bool = False
    """No start is drawn below the nominal position: what is put down comes from above."""
    spread_rad: float = 0.6
    max_candidates: int = 16


@dataclass(frozen=True, kw_only=True)
class StageCandidate:
    """One answer of a stage."""

    T_base_tcp: Pose
    width_m: float
    cost: float
    violations: Sequence[float]
    """f of each term [m or rad]."""


@dataclass(frozen=True, kw_only=True)
class StageSolution:
    """What came out of all starts."""

    candidates: tuple[StageCandidate, ...]
    """Feasible and distinct, the cheapest first; empty when none was found."""
    nearest: StageCandidate
    """The cheapest state of all, feasible or not: what it violates says what is in the way."""
    feasible: Flags
    """Whether each start ended with every constraint satisfied."""


@dataclass
class _Seen:
    """States and what they cost, as they come."""

    states: list[Zeta] = field(default_factory=list)
    costs: list[np.ndarray] = field(default_factory=list)
    violations: list[np.ndarray] = field(default_factory=list)

    def add(self, zeta: Zeta, violations: np.ndarray, costs: np.ndarray) -> None:
        self.states.append(zeta)
        self.costs.append(costs)
        self.violations.append(violations)

    def all(self) -> tuple[Zeta, np.ndarray, np.ndarray]:
        T = np.concatenate([zeta.T_base_tcp for zeta in self.states])
        width = np.concatenate([zeta.width_m for zeta in self.states])
        zeta = Zeta(T_base_tcp=T, width_m=width)
        return zeta, np.concatenate(self.violations), np.concatenate(self.costs)


def draw_starts(problem: StageProblem, config: SolveConfig, seed: int) -> Zeta:
    """Draw states around the nominal one; the first is the nominal one itself."""
    rng = np.random.default_rng(seed)
    num = config.num_starts
    shift = rng.uniform(-1.0, 1.0, (num, 3)) * SPREAD_M
    if config.only_above:
        shift[:, 2] = np.abs(shift[:, 2])
    about = np.zeros((num, 3))
    about[:, 2] = rng.uniform(-SPREAD_TURN_RAD, SPREAD_TURN_RAD, num)
    axis = rng.normal(size=(num, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turn = axis * rng.uniform(0.0, config.spread_rad, (num, 1))
    width = rng.uniform(0.0, problem.max_width_m, num)
    shift[0], about[0], turn[0], width[0] = 0.0, 0.0, 0.0, problem.nominal_width_m
    T = np.repeat(problem.nominal_T_base_tcp[None], num, axis=0)
    T[:, :3, :3] = se3.rotation_from_vector(about) @ T[:, :3, :3] @ se3.rotation_from_vector(turn)
    T[:, :3, 3] += shift
    return Zeta(T_base_tcp=T, width_m=width)


def solve(
    problem: StageProblem, config: SolveConfig | None = None, *, seed: int = 0
) -> StageSolution:
    """Minimise J from all starts and keep the distinct feasible states."""
    config = SolveConfig() if config is None else config
    zeta = draw_starts(problem, config, seed)
    ends = _descended(problem, config, zeta)
    for attempt in range(1, config.redraws + 1):
        stuck = np.flatnonzero(~ends.feasible)
        if not len(stuck):
            break
        again = draw_starts(problem, config, seed + attempt * _NEXT_SEED)[stuck]
        ends.replace(stuck, _descended(problem, config, again))
    return ends.solution(config)


def _descended(problem: StageProblem, config: SolveConfig, zeta: Zeta) -> "_Ends":
    descent = _Descent(problem, zeta)
    while descent.iterations < config.iterations and descent.step():
        pass
    return descent.ends()


@dataclass
class _Ends:
    """Where starts ended, and all they have seen."""

    feasible: Flags
    seen: _Seen

    def replace(self, rows: np.ndarray, others: "_Ends") -> None:
        """Put other starts in the place of some; nothing that was seen is lost."""
        self.feasible[rows] = others.feasible
        self.seen.states += others.seen.states
        self.seen.costs += others.seen.costs
        self.seen.violations += others.seen.violations

    def solution(self, config: SolveConfig) -> StageSolution:
        """Keep what is feasible and distinct."""
        zeta, violations, costs = self.seen.all()
        costs = np.where(np.isfinite(costs), costs, np.inf)
        order = np.argsort(costs, kind="stable")

        def candidate(index: int) -> StageCandidate:
            return StageCandidate(
                T_base_tcp=zeta.T_base_tcp[index],
                width_m=float(zeta.width_m[index]),
                cost=float(costs[index]),
                violations=violations[index].tolist(),
            )

        feasible = np.all(violations <= 0, axis=1)
        chosen = distinct(zeta.T_base_tcp, order[feasible[order]], config.max_candidates)
        return StageSolution(
            candidates=tuple(candidate(index) for index in chosen),
            nearest=candidate(int(order[0])),
            feasible=self.feasible,
        )


class _Descent:
    """All starts on their way down."""

    def __init__(self, problem: StageProblem, zeta: Zeta) -> None:
        self.iterations = 0
        self._problem = problem
        num = len(zeta)
        self._T, self._width = zeta.T_base_tcp.copy(), zeta.width_m.copy()
        self._violations, self._r, self._J = linearised(problem, zeta)
        self._damping = np.full(num, DAMPING)
        self._drawn: Flags = np.all(self._violations <= 0, axis=1)
        self._open: Flags = np.isfinite(self._r).all(axis=1)
        self._seen = _Seen()
        self._seen.add(zeta, self._violations.copy(), np.square(self._r).sum(axis=1))

    def step(self) -> bool:
        """Try one step of every start that is not done; False when all are."""
        rows = np.flatnonzero(self._open)
        if not len(rows):
            return False
        self.iterations += 1
        trial = self._trial(rows)
        violations, r = _evaluated(self._problem, trial)
        self._seen.add(trial, violations, np.square(r).sum(axis=1))
        before, cost = self._cost(rows, self._r[rows]), self._cost(rows, r)
        better = cost < before  # what is not a number is not better
        won, lost = rows[better], rows[~better]
        self._damping[won] = np.maximum(self._damping[won] * 0.3, 1e-9)
        self._damping[lost] *= 5.0
        done = better & (before - cost <= SETTLED * before + _NOTHING)
        done |= self._damping[rows] > _HOPELESS
        self._T[won], self._width[won] = trial.T_base_tcp[better], trial.width_m[better]
        self._violations[won], self._r[won] = violations[better], r[better]
        self._draw(rows, done)
        again = won[self._open[won]]
        if len(again):
            here = Zeta(T_base_tcp=self._T[again], width_m=self._width[again])
            _, self._r[again], self._J[again] = linearised(self._problem, here)
        return True

    def _draw(self, rows: np.ndarray, done: np.ndarray) -> None:
        """Let the regulariser draw starts that have arrived, or that came no further."""
        arrived = (self._violations[rows] <= 0).all(axis=1) | done
        arrived |= self.iterations >= FREE_ITERATIONS
        first = arrived & ~self._drawn[rows]
        self._drawn[rows[first]] = True
        self._damping[rows[first]] = DAMPING
        self._open[rows[done & ~first]] = False

    def _cost(self, rows: np.ndarray, r: np.ndarray) -> np.ndarray:
        """J of some starts, without the regulariser where it does not draw yet."""
        squares = np.square(r)
        penalties = squares[:, :-NUM_VARIABLES].sum(axis=1)
        omega = squares[:, -NUM_VARIABLES:].sum(axis=1)
        return np.asarray(penalties + self._drawn[rows] * omega)

    def _trial(self, rows: np.ndarray) -> Zeta:
        """Solve the damped normal equations of some starts and go there."""
        share = np.ones((len(rows), self._r.shape[1]))
        share[:, -NUM_VARIABLES:] = self._drawn[rows, None]
        J, r = self._J[rows] * share[:, :, None], self._r[rows] * share
        H = np.swapaxes(J, 1, 2) @ J
        damping = self._damping[rows, None]
        diagonal = np.einsum("nii->ni", H)
        diagonal += damping * (diagonal + 1e-3)  # the view writes into H
        g = np.einsum("nij,ni->nj", J, r)
        step = -np.linalg.solve(H, g[:, :, None])[:, :, 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, LONGEST_STEP / np.maximum(length, 1e-12))
        step *= UNITS
        width = np.clip(self._width[rows] + step[:, 6], 0.0, self._problem.max_width_m)
        return Zeta(T_base_tcp=moved(self._T[rows], step), width_m=width)

    def ends(self) -> _Ends:
        """Say where all starts are now."""
        return _Ends(feasible=np.asarray(np.all(self._violations <= 0, axis=1)), seen=self._seen)


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


def _evaluated(problem: StageProblem, zeta: Zeta) -> tuple[np.ndarray, np.ndarray]:
    """The greatest violation of each term, and the residuals."""
    violations = problem.violations(zeta)
    greatest = np.stack([parts.max(axis=1) for parts in violations], axis=1)
    return greatest, np.asarray(problem.residuals(zeta, violations))


def linearised(problem: StageProblem, zeta: Zeta) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Violations, residuals and their derivatives by differences: eight states in place of one."""
    num, blocks = len(zeta), NUM_VARIABLES + 1
    step = np.zeros((blocks, num, NUM_VARIABLES))
    step[np.arange(1, blocks), :, np.arange(NUM_VARIABLES)] = _DIFFERENCE
    steps = step.reshape(-1, NUM_VARIABLES) * UNITS
    T = moved(np.concatenate([zeta.T_base_tcp] * blocks), steps)
    width = np.concatenate([zeta.width_m] * blocks) + steps[:, 6]
    violations, r = _evaluated(problem, Zeta(T_base_tcp=T, width_m=width))
    r = r.reshape(blocks, num, -1)
    return violations[:num], r[0].copy(), np.moveaxis(r[1:] - r[0], 0, 2) / _DIFFERENCE
