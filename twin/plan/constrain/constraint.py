"""One constraint, ready to be asked: f of each state, f <= 0 where it is satisfied.

A constraint measures one number of a state or more and says in which interval each should be. f is
how far the worst is outside its interval, in the unit of the kind.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bridge.task.relations import SHOWN, Measured
from twin.plan.problem import Array, State

SCALES = {"m": 0.01, "rad": np.radians(10.0), "m/s": 0.1}


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """One constraint of a problem."""

    record: Mapping[str, Any]
    """As it was written, see ``bridge/task/schemas/constraint.schema.json``."""
    measured: Callable[[State], Sequence[Measured]]
    unit: str = "m"
    """Of the violation: ``m``, ``rad`` or ``m/s``."""
    along: Callable[[State, Array | None], Array] | None = None
    """Kinds about a path and not a state: f at its worst, of states as ``worst_along`` takes them.
    A single state is then always well."""

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
        found = self.measured(state)
        return "; ".join(f"{each.what} {_wanted(each)} {SHOWN[each.unit][1]}" for each in found)

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

    def explain(self, state: State) -> str:
        """Say what is asked and what the first of the states has, in words with numbers."""
        holds = bool(self.violation(state)[0] <= 0)
        told = "; ".join(map(_sentence, self.measured(state)))
        return f"{self.kind} {'holds' if holds else 'is violated'}: {told}"


def _wanted(asked: Measured) -> str:
    """The interval in words, without the unit."""
    factor, _ = SHOWN[asked.unit]
    low, high = asked.low * factor + 0.0, asked.high * factor + 0.0  # never -0
    if np.isneginf(low):
        return f"at most {high:.4g}"
    if np.isposinf(low) or np.isposinf(high):
        return f"at least {low:.4g}"
    return f"{low:.4g} to {high:.4g}"


def _sentence(asked: Measured) -> str:
    """What is measured in the first state, what is wanted, and by how much it misses."""
    factor, unit = SHOWN[asked.unit]
    value = float(np.ravel(asked.value)[0])
    missed = max(value - asked.high, asked.low - value) * factor
    verdict = f", missed by {missed:.3g}" if missed > 0 else ""
    return f"{asked.what} is {value * factor:.4g} {unit} (wanted {_wanted(asked)}{verdict})"


def worst_along(constraint: Constraint, states: State, *, times_s: Array | None = None) -> Array:
    """Return f at its worst along each of many paths, ``(num_states,)``.

    Args:
        states: Poses along the paths, ``(num_states, num_steps, 4, 4)``, of what stands still
            ``(1, 1, 4, 4)``; widths ``(num_states, num_steps)``.
        times_s: Of the steps, ``(num_steps,)``. Without them no speed is known, and a limit of it
            is left to the time law.
    """
    if constraint.along is not None:
        return constraint.along(states, times_s)
    num_states, num_steps = states.T_base_tcp.shape[:2]
    found = constraint.violation(flattened(states)).reshape(num_states, num_steps)
    return np.amax(found, axis=-1)


def flattened(states: State) -> State:
    """All steps of all paths as one batch of states, path by path."""
    num_states, num_steps = states.T_base_tcp.shape[:2]

    def flat(Ts: Array) -> Array:
        return np.broadcast_to(Ts, (num_states, num_steps, 4, 4)).reshape(-1, 4, 4)

    return State(
        Ts_base_object={name: flat(Ts) for name, Ts in states.Ts_base_object.items()},
        T_base_tcp=flat(states.T_base_tcp),
        width_m=np.broadcast_to(states.width_m, (num_states, num_steps)).reshape(-1),
    )


def violated(constraints: Sequence[Constraint], state: State) -> list[str]:
    """Say what the first state misses; of a best compromise, what contradicts itself."""
    found = [each for c in constraints for each in c.measured(state)]
    return [_sentence(each) for each in found if np.ravel(each.excess)[0] > 0]
