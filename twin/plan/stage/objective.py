"""The cost of a stage, Eq. 7 of the paper: penalties on violated constraints and a regulariser.

    zeta* = argmin J(zeta),   zeta = (T, gamma)
    J(zeta) = sum_l w_l phi_l([f_l(zeta)]_+) + lambda_reg Omega(zeta)

T is the pose of the tool in SE(3), gamma the width between the finger pads. A sub-path constraint
is evaluated along the straight way from where the stage starts to zeta and enters by its worst
violation. A constraint is satisfied where f <= 0; f is tightened by a small margin, so that the
regulariser leaves an answer inside of what is allowed rather than just outside of it.
Every penalty is the square of a residual, which is what Gauss-Newton needs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from twin.plan.constrain.arrays import Array, like, namespace
from twin.plan.constrain.constraint import Constraint, flattened, worst_along
from twin.plan.problem import State
from twin.plan.stage.motion import interpolated, rotation_vector

Penalty = Literal["squared", "huber"]
"""phi of a violation in units of its scale: its square, or 2 x - 1 beyond one unit."""

LENGTH_M = 0.01
"""Unit of lengths in the regulariser and in steps of the solver."""
ANGLE_RAD = float(np.deg2rad(10.0))
"""Unit of angles."""
NUM_VARIABLES = 7


@dataclass(frozen=True, kw_only=True)
class CostTerm:
    """One constraint in the sum."""

    name: str
    violation: Callable[[State], Array]
    """f of states at the end, or of ways where the term is about one: ``(num_states,)``, or a
    column for each of its parts ``(num_states, num_parts)``, in metres or radians; satisfied where
    none is above zero."""
    scale: float = LENGTH_M
    """What counts as one."""
    weight: float = 1.0
    """w, above zero."""
    penalty: Penalty = "squared"
    """phi."""
    unit: str = "m"
    """Of the violation, see ``SCALES``."""

    def __post_init__(self) -> None:
        """Refuse weights and scales that are none."""
        if not (self.weight > 0 and self.scale > 0):
            message = (
                f"the term {self.name} has the weight {self.weight} and the scale {self.scale}: "
                "both must be above zero."
            )
            raise ValueError(message)

    @staticmethod
    def of(
        constraint: Constraint, *, weight: float = 1.0, penalty: Penalty = "squared"
    ) -> "CostTerm":
        """Weigh a compiled constraint that must hold where the stage ends.

        Args:
            constraint: With its scale; each of its parts counts.
            weight: w.
            penalty: phi.
        """
        return CostTerm(
            name=constraint.kind,
            violation=constraint.parts,
            scale=constraint.scale,
            weight=weight,
            penalty=penalty,
            unit=constraint.unit,
        )

    @staticmethod
    def along(
        constraint: Constraint, *, weight: float = 1.0, penalty: Penalty = "squared"
    ) -> "CostTerm":
        """Weigh a compiled constraint that must hold all the way.

        Args:
            constraint: With its scale; its worst violation counts.
            weight: w.
            penalty: phi.
        """
        return CostTerm(
            name=f"{constraint.kind} on the way",
            violation=lambda states: worst_along(constraint, states),
            scale=constraint.scale,
            weight=weight,
            penalty=penalty,
            unit=constraint.unit,
        )


def worst_of(violation: Callable[[State], Array]) -> Callable[[State], Array]:
    """Make a function of states one of ways: the worst of each way.

    Args:
        violation: Of ``(num_states, ...)``.

    Returns:
        Of ``(num_states, num_steps, ...)``.
    """

    def found(states: State) -> Array:
        num_states, num_steps = states.T_base_tcp.shape[:2]
        values = violation(flattened(states))
        rows = values.reshape(num_states, num_steps, *values.shape[1:])
        return namespace(rows).amax(rows, 1)

    return found


@dataclass(frozen=True, kw_only=True)
class Zeta:
    """Decision variables of many states at once, NumPy or torch."""

    T_base_tcp: Array
    """``(num_states, 4, 4)``."""
    width_m: Array
    """``(num_states,)``."""

    def __len__(self) -> int:
        """How many states."""
        return len(self.T_base_tcp)

    def __getitem__(self, rows: Array) -> "Zeta":
        """Some of the states."""
        return Zeta(T_base_tcp=self.T_base_tcp[rows], width_m=self.width_m[rows])


@dataclass(frozen=True, kw_only=True)
class StageProblem:
    """One stage as an optimisation problem."""

    nominal_T_base_tcp: Float[np.ndarray, "4 4"]
    """Where the regulariser draws the tool."""
    nominal_width_m: float
    """And the width."""
    subgoal: tuple[CostTerm, ...] = ()
    """What must hold where the stage ends."""
    path: tuple[CostTerm, ...] = ()
    """What must hold all the way there."""
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """Objects that stay where they are during the stage."""
    Ts_tcp_object: Mapping[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """Objects that move with the tool, as it took them (errata: at the grasp instant)."""
    start_T_base_tcp: Float[np.ndarray, "4 4"] | None = None
    """Where the way begins; needed when there are terms along it."""
    start_width_m: float = 0.0
    """Width on the way: what is carried is held."""
    num_path_steps: int = 8
    """States on the way that are looked at, the last one included."""
    lambda_reg: float = 1e-3
    """Weight of the regulariser Omega, the squared deviation from the nominal pose and width in
    units of 1 cm and 10 degrees."""
    margin: float = 0.02
    """Constraints are tightened by this share of their scale."""
    max_width_m: float = 0.1
    """Of the gripper."""

    def __post_init__(self) -> None:
        """Refuse a stage without constraints, or with a way that begins nowhere."""
        if not self.terms:
            message = "a stage without constraints has nothing to solve."
            raise ValueError(message)
        if self.path and self.start_T_base_tcp is None:
            message = "sub-path constraints need start_T_base_tcp, where the way begins."
            raise ValueError(message)

    @property
    def terms(self) -> tuple[CostTerm, ...]:
        """Those at the end, then those along the way."""
        return (*self.subgoal, *self.path)

    def violations(self, zeta: Zeta) -> list[Array]:
        """Evaluate f of every term, ``(num_states, num_parts)`` each; on the way the worst one."""
        end = self._state(zeta.T_base_tcp, zeta.width_m)
        found = [_columns(term.violation(end)) for term in self.subgoal]
        if self.path:
            way = self._way(zeta)
            found += [_columns(term.violation(way)) for term in self.path]
        return found

    def residuals(self, zeta: Zeta, violations: Sequence[Array]) -> Array:
        """Return numbers whose squares add up to J, ``(num_states, num_parts + 7)``.

        Args:
            zeta: The states.
            violations: Of these states, from ``violations``.
        """
        columns = [
            _residual(term, found, self.margin)
            for term, found in zip(self.terms, violations, strict=True)
        ]
        share = float(np.sqrt(self.lambda_reg))
        columns.append(self._deviation(zeta) * share)
        return namespace(columns[0]).concatenate(columns, 1)

    def cost(self, zeta: Zeta) -> Float[np.ndarray, " num_states"]:
        """Evaluate J of NumPy states."""
        residuals = self.residuals(zeta, self.violations(zeta))
        return np.asarray(np.square(residuals).sum(axis=1))

    def _deviation(self, zeta: Zeta) -> Array:
        """Way from the nominal pose and width, in units."""
        T, width = zeta.T_base_tcp, zeta.width_m
        R_nominal = like(self.nominal_T_base_tcp[:3, :3], T)
        return namespace(T).concatenate(
            [
                (T[:, :3, 3] - like(self.nominal_T_base_tcp[:3, 3], T)) / LENGTH_M,
                rotation_vector(R_nominal.T @ T[:, :3, :3]) / ANGLE_RAD,
                (width[:, None] - self.nominal_width_m) / LENGTH_M,
            ],
            1,
        )

    def _way(self, zeta: Zeta) -> State:
        """States along the ways, ``(num_states, num_steps, ...)``."""
        start = self.nominal_T_base_tcp if self.start_T_base_tcp is None else self.start_T_base_tcp
        num = self.num_path_steps
        T = interpolated(start, zeta.T_base_tcp, np.arange(1, num + 1) / num)
        return self._state(T, like(np.full(T.shape[:2], self.start_width_m), T))

    def _state(self, T_base_tcp: Array, width_m: Array) -> State:
        xp = namespace(T_base_tcp)
        poses = {
            name: xp.broadcast_to(like(T, T_base_tcp), T_base_tcp.shape)
            for name, T in self.Ts_base_object.items()
        }
        poses |= {name: T_base_tcp @ like(T, T_base_tcp) for name, T in self.Ts_tcp_object.items()}
        return State(Ts_base_object=poses, T_base_tcp=T_base_tcp, width_m=width_m)


def _columns(values: Array) -> Array:
    """One column for each part."""
    return values[:, None] if len(values.shape) == 1 else values


def _residual(term: CostTerm, violation: Array, margin: float) -> Array:
    """Square root of w phi, smooth above zero."""
    xp = namespace(violation)
    x = xp.clip(violation / term.scale + margin, 0.0, None)
    if term.penalty == "huber":
        beyond = xp.clip(x - 1.0, 0.0, None)
        # Up to one unit x, whose square is phi; beyond it the root of 2 x - 1.
        x = (x - beyond) * (1.0 + 2.0 * beyond) ** 0.5
    return x * float(np.sqrt(term.weight))


def zeta_of(
    Ts_base_tcp: Sequence[Float[np.ndarray, "4 4"]] | Float[np.ndarray, "num 4 4"],
    widths_m: Sequence[float] | Float[np.ndarray, " num"],
) -> Zeta:
    """Put poses and widths together.

    Args:
        Ts_base_tcp: Poses of the tool.
        widths_m: One for each.
    """
    return Zeta(
        T_base_tcp=np.array(Ts_base_tcp, dtype=np.float64).reshape(-1, 4, 4),
        width_m=np.array(widths_m, dtype=np.float64).reshape(-1),
    )
