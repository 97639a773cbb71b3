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
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float

from twin.plan.problem import State
from twin.plan.stage.motion import (
    arrays_like,
    concatenated,
    interpolated,
    positive_part,
    rotation_vector,
    worst,
)

Penalty = Literal["squared", "huber"]
"""phi of a violation in units of its scale: its square, or 2 x - 1 beyond one unit."""

LENGTH_M = 0.01
"""Unit of lengths in the regulariser and in steps of the solver."""
ANGLE_RAD = float(np.deg2rad(10.0))
"""Unit of angles."""
NUM_VARIABLES = 7


class Measurable(Protocol):
    """A constraint as ``twin.plan.constrain`` compiles it."""

    @property
    def kind(self) -> str:
        """Which kind of constraint it is."""

    @property
    def scale(self) -> float:
        """What counts as one: 1 cm or 10 degrees."""

    def parts(self, state: State) -> Any:
        """Each of its terms, ``(num_states, num_parts)``: above 0 violated [m or rad]."""


@dataclass(frozen=True, kw_only=True)
class Term:
    """One constraint in the sum."""

    name: str
    violation: Callable[[State], Any]
    """f: ``(num_states,)``, or a column for each of its parts ``(num_states, num_parts)``, in
    metres or radians; satisfied where none is above zero."""
    scale: float = LENGTH_M
    """What counts as one."""
    weight: float = 1.0
    """w, above zero."""
    penalty: Penalty = "squared"
    """phi."""

    def __post_init__(self) -> None:
        """Refuse weights and scales that are none."""
        if not (self.weight > 0 and self.scale > 0):
            message = (
                f"the term {self.name} has the weight {self.weight} and the scale {self.scale}: "
                "both must be above zero."
            )
            raise ValueError(message)

    @staticmethod
    def of(constraint: Measurable, *, weight: float = 1.0, penalty: Penalty = "squared") -> "Term":
        """Weigh a compiled constraint.

        Args:
            constraint: With its scale.
            weight: w.
            penalty: phi.
        """
        return Term(
            name=constraint.kind,
            violation=constraint.parts,
            scale=constraint.scale,
            weight=weight,
            penalty=penalty,
        )


@dataclass(frozen=True, kw_only=True)
class Zeta:
    """Decision variables of many states at once, NumPy or torch."""

    T_base_tcp: Any
    """``(num_states, 4, 4)``."""
    width_m: Any
    """``(num_states,)``."""

    def __len__(self) -> int:
        """How many states."""
        return len(self.T_base_tcp)

    def __getitem__(self, rows: Any) -> "Zeta":
        """Some of the states."""
        return Zeta(T_base_tcp=self.T_base_tcp[rows], width_m=self.width_m[rows])


@dataclass(frozen=True, kw_only=True)
class StageProblem:
    """One stage as an optimisation problem."""

    nominal_T_base_tcp: Float[np.ndarray, "4 4"]
    """Where the regulariser draws the tool."""
    nominal_width_m: float
    """And the width."""
    subgoal: tuple[Term, ...] = ()
    """What must hold where the stage ends."""
    path: tuple[Term, ...] = ()
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
    def terms(self) -> tuple[Term, ...]:
        """Those at the end, then those along the way."""
        return (*self.subgoal, *self.path)

    def violations(self, zeta: Zeta) -> list[Any]:
        """Evaluate f of every term, ``(num_states, num_parts)`` each; on the way the worst one."""
        found = [_columns(term.violation(self._end(zeta))) for term in self.subgoal]
        if self.path:
            way, num = self._way(zeta), len(zeta)
            found += [worst(_columns(term.violation(way)), num) for term in self.path]
        return found

    def residuals(self, zeta: Zeta, violations: Sequence[Any]) -> Any:
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
        return concatenated([*columns, self._deviation(zeta) * share])

    def cost(self, zeta: Zeta) -> Float[np.ndarray, " num_states"]:
        """Evaluate J of NumPy states."""
        residuals = self.residuals(zeta, self.violations(zeta))
        return np.asarray(np.square(residuals).sum(axis=1))

    def _deviation(self, zeta: Zeta) -> Any:
        """Way from the nominal pose and width, in units."""
        T, width, nominal = zeta.T_base_tcp, zeta.width_m, self.nominal_T_base_tcp
        R_nominal, p_nominal = arrays_like(T, nominal[:3, :3].T, nominal[:3, 3])
        return concatenated(
            [
                (T[:, :3, 3] - p_nominal) / LENGTH_M,
                rotation_vector(R_nominal @ T[:, :3, :3]) / ANGLE_RAD,
                (width[:, None] - self.nominal_width_m) / LENGTH_M,
            ]
        )

    def _end(self, zeta: Zeta) -> State:
        return self._state(zeta.T_base_tcp, zeta.width_m)

    def _way(self, zeta: Zeta) -> State:
        """States along the way, those of one zeta one after the other."""
        start = self.nominal_T_base_tcp if self.start_T_base_tcp is None else self.start_T_base_tcp
        num = self.num_path_steps
        fractions = np.arange(1, num + 1) / num
        T = interpolated(start, zeta.T_base_tcp, fractions)
        (width,) = arrays_like(T, np.full(len(T), self.start_width_m))
        return self._state(T, width)

    def _state(self, T_base_tcp: Any, width_m: Any) -> State:
        poses: dict[str, Any] = {}
        for name, T in self.Ts_base_object.items():
            (fixed,) = arrays_like(T_base_tcp, np.broadcast_to(T, (len(T_base_tcp), 4, 4)))
            poses[name] = fixed
        for name, T in self.Ts_tcp_object.items():
            (held,) = arrays_like(T_base_tcp, T)
            poses[name] = T_base_tcp @ held
        return State(Ts_base_object=poses, T_base_tcp=T_base_tcp, width_m=width_m)


def _columns(values: Any) -> Any:
    """One column for each part."""
    return values[:, None] if len(values.shape) == 1 else values


def _residual(term: Term, violation: Any, margin: float) -> Any:
    """Square root of w phi, smooth above zero."""
    x = positive_part(violation / term.scale + margin)
    if term.penalty == "huber":
        beyond = positive_part(x - 1.0)
        # 2 x - 1 = (1 + beyond)^2 - beyond^2 beyond one unit, x^2 below.
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
