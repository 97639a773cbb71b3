"""One constraint, ready to be asked: f of each state, f <= 0 where it is satisfied.

A constraint measures one number of a state or more and says in which interval each should be. f is
how far the worst is outside its interval, in the unit of the kind.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bridge.task.relations import Measured, shown
from twin.plan.problem import Array, Numbers, State

SCALES = {"m": 0.01, "rad": np.radians(10.0), "m/s": 0.1}


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """One constraint of a problem."""

    record: Mapping[str, Any]
    """As it was written, see ``bridge/task/schemas/constraint.schema.json``."""
    measured: Callable[[State], Sequence[Measured]]
    unit: str = "m"
    """Of the violation: ``m``, ``rad`` or ``m/s``."""
    along: Callable[[State, Numbers], float] | None = None
    """Kinds about a path and not a state: f at its worst, of the steps of a path and their times
    [s]. A single state is then always well."""

    @property
    def kind(self) -> str:
        """Of the record."""
        return str(self.record["kind"])

    @property
    def scale(self) -> float:
        """What counts as one unit of violation: 1 cm, 10 degrees, 10 cm/s."""
        return float(SCALES[self.unit])

    def wanted(self, state: State) -> str:
        """What is asked, in words; a state says what that is about."""
        return "; ".join(f"{each.what} {each.wanted()}" for each in self.measured(state))

    def parts(self, state: State) -> Array:
        """Return f of each number, in the unit of the kind, ``(num_states, num_numbers)``.

        The violation is the greatest. Least squares over the parts sees what the others need.
        """
        shape = state.T_base_tcp.shape[:1]  # of what stands still there is one number
        found = [
            np.broadcast_to(each.excess * (self.scale / SCALES[each.unit]), shape)
            for each in self.measured(state)
        ]
        return np.stack(found, axis=-1)

    def violation(self, state: State) -> Array:
        """Return f of each state, ``(num_states,)``: above 0 violated, by so much of ``unit``."""
        return np.amax(self.parts(state), axis=-1)

    def worst_along(self, steps: State, times_s: Numbers) -> float:
        """Return f at its worst along a path whose steps have these times."""
        if self.along is not None:
            return self.along(steps, times_s)
        return float(self.violation(steps).max())

    def explain(self, state: State) -> str:
        """Say what is asked and what the first of the states has, in words with numbers."""
        holds = bool(self.violation(state)[0] <= 0)
        told = "; ".join(map(_sentence, self.measured(state)))
        return f"{self.kind} {'holds' if holds else 'is violated'}: {told}"


def _sentence(asked: Measured) -> str:
    """What is measured in the first state, what is wanted, and by how much it misses."""
    missed = float(np.ravel(asked.excess)[0])
    verdict = f", missed by {shown(missed, asked.unit, 1)}" if missed > 0 else ""
    return f"{asked.told(1)} (wanted {asked.wanted()}{verdict})"


def violated(constraints: Sequence[Constraint], state: State) -> list[str]:
    """Say what the first state misses; of a best compromise, what contradicts itself."""
    found = [each for c in constraints for each in c.measured(state)]
    return [_sentence(each) for each in found if np.ravel(each.excess)[0] > 0]
