"""One constraint, ready to be asked: f of each state, f <= 0 where it is satisfied.

A constraint is one or more terms; each measures a number of a state and says in which interval it
should be. f is how far the worst term is outside its interval, in the unit of the first term.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from twin.plan.problem import Array, State

Measure = Callable[[State], Array]
"""A number of each state, ``(num_states,)``."""
SCALES = {"m": 0.01, "rad": np.radians(10.0), "m/s": 0.1}
SHOWN = {"m": (1e3, "mm"), "rad": (180 / np.pi, "degrees"), "m/s": (1e3, "mm/s")}
"""By unit: what a number of it is multiplied by for a person, and what it then is."""


@dataclass(frozen=True, kw_only=True)
class Term:
    """One measured number and the interval it should be in."""

    what: str
    """What is measured, in words: "height of the cube's bottom"."""
    measure: Measure
    low: float = -np.inf
    high: float = np.inf
    unit: str = "m"
    """``m``, ``rad`` or ``m/s``."""

    def excess(self, state: State) -> Array:
        """How far the number is outside its interval; negative inside, ``(num_states,)``."""
        value = self.measure(state)
        value = value + 0.0 * state.T_base_tcp[:, 0, 0]  # of what stands still there is one
        if np.isneginf(self.low):
            return value - self.high
        if np.isposinf(self.high):
            return self.low - value
        return abs(value - (self.low + self.high) / 2) - (self.high - self.low) / 2

    @property
    def wanted(self) -> str:
        """The interval in words, without the unit."""
        factor, _ = SHOWN[self.unit]
        low, high = self.low * factor + 0.0, self.high * factor + 0.0  # never -0
        if np.isneginf(low):
            return f"at most {high:.4g}"
        if np.isposinf(low) or np.isposinf(high):
            return f"at least {low:.4g}"
        return f"{low:.4g} to {high:.4g}"

    def sentence(self, state: State) -> str:
        """What is measured in the first state, what is wanted, and by how much it misses."""
        factor, unit = SHOWN[self.unit]
        value = float(self.measure(state)[0])
        missed = max(value - self.high, self.low - value) * factor
        verdict = f", missed by {missed:.3g}" if missed > 0 else ""
        return f"{self.what} is {value * factor:.4g} {unit} (wanted {self.wanted}{verdict})"


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """One constraint of a problem."""

    kind: str
    record: Mapping[str, Any]
    """As it was written, see ``bridge/task/schemas/constraint.schema.json``."""
    terms: tuple[Term, ...]
    along: Callable[[State, Array | None], Array] | None = None
    """Kinds about a path and not a state: f at its worst, of states as ``worst_along`` takes them.
    A single state is then always well."""

    @staticmethod
    def of(record: Mapping[str, Any], *terms: Term) -> "Constraint":
        """Make one of a record and what it measures."""
        return Constraint(kind=record["kind"], record=dict(record), terms=terms)

    @property
    def scale(self) -> float:
        """What counts as one unit of violation: 1 cm, 10 degrees, 10 cm/s."""
        return float(SCALES[self.terms[0].unit])

    @property
    def unit(self) -> str:
        """Of the violation: ``m``, ``rad`` or ``m/s``."""
        return self.terms[0].unit

    @property
    def wanted(self) -> str:
        """What is asked, in words."""
        return "; ".join(f"{term.what} {term.wanted} {SHOWN[term.unit][1]}" for term in self.terms)

    def parts(self, state: State) -> Array:
        """Return f of each term, in the unit of the first one, ``(num_states, num_terms)``.

        The violation is the greatest. Least squares over the parts sees what the others need.
        """
        found = [
            term.excess(state) * (1.0 if term.unit == self.unit else self.scale / SCALES[term.unit])
            for term in self.terms
        ]
        return np.stack(found, axis=-1)

    def violation(self, state: State) -> Array:
        """Return f of each state, ``(num_states,)``: above 0 violated, by so much of ``unit``."""
        return np.amax(self.parts(state), axis=-1)

    def explain(self, state: State) -> str:
        """Say what is asked and what the first of the states has, in words with numbers."""
        holds = bool(self.violation(state)[0] <= 0)
        told = "; ".join(term.sentence(state) for term in self.terms)
        return f"{self.kind} {'holds' if holds else 'is violated'}: {told}"


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
    """Explain what the first state violates; of a best compromise, what contradicts itself."""
    return [c.explain(state) for c in constraints if bool(c.violation(state)[0] > 0)]
