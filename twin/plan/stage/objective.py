"""The cost of a stage, Eq. 7 of the paper: penalties on violated constraints and a regulariser.

    zeta* = argmin J(zeta),   zeta = (T, gamma)
    J(zeta) = sum_l phi([f_l(zeta)]_+) + lambda_reg Omega(zeta)

T is the pose of the tool in SE(3), gamma the width between the finger pads, phi the square of a
violation in units of its scale. A constraint is satisfied where f <= 0; f is tightened by a small
margin, so that the regulariser leaves an answer inside of what is allowed rather than just outside
of it. Every penalty is the square of a residual, which is what Gauss-Newton needs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from twin.plan.arrays import Ids, Numbers, Pose, Poses
from twin.plan.constrain.constraint import Constraint
from twin.plan.problem import Array, State

LENGTH_M = 0.01
"""Unit of lengths in the regulariser and in steps of the solver."""
ANGLE_RAD = float(np.deg2rad(10.0))
NUM_VARIABLES = 7
LAMBDA_REG = 1e-3
"""Weight of the regulariser Omega, the squared deviation from the nominal pose and width in units
of 1 cm and 10 degrees."""
MARGIN = 0.02
"""Constraints are tightened by this share of their scale."""


@dataclass(frozen=True, kw_only=True)
class CostTerm:
    """One constraint in the sum."""

    name: str
    violation: Callable[[State], Array]
    """f of states at the end: ``(num_states,)``, or a column for each of its parts
    ``(num_states, num_parts)``, in metres or radians; satisfied where none is above zero."""
    scale: float = LENGTH_M
    unit: str = "m"

    @staticmethod
    def of(constraint: Constraint) -> "CostTerm":
        """A compiled constraint that must hold where the stage ends; each of its parts counts."""
        return CostTerm(
            name=constraint.kind,
            violation=constraint.parts,
            scale=constraint.scale,
            unit=constraint.unit,
        )


@dataclass(frozen=True, kw_only=True)
class Zeta:
    """Decision variables of many states at once."""

    T_base_tcp: Poses
    width_m: Numbers

    def __len__(self) -> int:
        """How many states."""
        return len(self.T_base_tcp)

    def __getitem__(self, rows: Ids) -> "Zeta":
        """Some of the states."""
        return Zeta(T_base_tcp=self.T_base_tcp[rows], width_m=self.width_m[rows])


def moved(T: Poses, step: Float[np.ndarray, "num num_variables"]) -> Poses:
    """Poses after steps: of the position in the base frame [m], of a turn in the tool's [rad]."""
    found = T.copy()
    found[:, :3, :3] = T[:, :3, :3] @ se3.rotation_from_vector(step[:, 3:6])
    found[:, :3, 3] += step[:, :3]
    return found


@dataclass(frozen=True, kw_only=True)
class StageProblem:
    """One stage as an optimisation problem."""

    nominal_T_base_tcp: Pose
    nominal_width_m: float
    subgoal: tuple[CostTerm, ...]
    """What must hold where the stage ends; at least one."""
    Ts_base_object: Mapping[str, Pose] = field(default_factory=dict)
    """Objects that stay where they are during the stage."""
    Ts_tcp_object: Mapping[str, Pose] = field(default_factory=dict)
    """Objects that move with the tool, as it took them (errata: at the grasp instant)."""
    max_width_m: float = 0.1

    def violations(self, zeta: Zeta) -> list[Float[np.ndarray, "num_states num_parts"]]:
        """Evaluate f of every term."""
        end = self._state(zeta)
        found = [np.asarray(term.violation(end)) for term in self.subgoal]
        return [values[:, None] if values.ndim == 1 else values for values in found]

    def residuals(
        self, zeta: Zeta, violations: Sequence[Float[np.ndarray, "num_states num_parts"]]
    ) -> Float[np.ndarray, "num_states num_residuals"]:
        """Return numbers whose squares add up to J, those of the regulariser last."""
        columns = [
            np.clip(found / term.scale + MARGIN, 0.0, None)
            for term, found in zip(self.subgoal, violations, strict=True)
        ]
        columns.append(self._deviation(zeta) * float(np.sqrt(LAMBDA_REG)))
        return np.concatenate(columns, axis=1)

    def cost(self, zeta: Zeta) -> Numbers:
        """Evaluate J."""
        residuals = self.residuals(zeta, self.violations(zeta))
        return np.asarray(np.square(residuals).sum(axis=1))

    def _deviation(self, zeta: Zeta) -> Float[np.ndarray, "num_states 7"]:
        """Way from the nominal pose and width, in units."""
        T, nominal = zeta.T_base_tcp, self.nominal_T_base_tcp
        turn = se3.vector_from_rotation(nominal[:3, :3].T @ T[:, :3, :3])
        return np.concatenate(
            [
                (T[:, :3, 3] - nominal[:3, 3]) / LENGTH_M,
                turn / ANGLE_RAD,
                (zeta.width_m[:, None] - self.nominal_width_m) / LENGTH_M,
            ],
            axis=1,
        )

    def _state(self, zeta: Zeta) -> State:
        T_base_tcp = zeta.T_base_tcp
        poses = {
            name: np.broadcast_to(T, T_base_tcp.shape) for name, T in self.Ts_base_object.items()
        }
        poses |= {name: T_base_tcp @ T for name, T in self.Ts_tcp_object.items()}
        return State(Ts_base_object=poses, T_base_tcp=T_base_tcp, width_m=zeta.width_m)
