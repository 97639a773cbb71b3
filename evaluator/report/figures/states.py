"""Predicted against localised and replayed final states, as distributions of errors."""

import math
from collections.abc import Callable, Mapping, Sequence

from evaluator.compare.drawn import Shares, shares_of
from evaluator.compare.states import StateSummary
from evaluator.report.figures.spreads import Panel, Subject

PAIRS = (
    ("plan", "recorded", "plan to localised"),
    ("planned", "recorded", "planned replay to localised"),
    ("executed", "recorded", "executed replay to localised"),
    ("plan", "planned", "plan to planned replay"),
)
"""Who predicts, what it is held against, and what the line is called."""

SUBJECT = Subject(
    id="states",
    title="Predicted final states",
    caption="Final state of each object: distance of what was predicted from where it was "
    "localised after the trial, or from where the replay left it; rotation modulo the object's "
    "symmetry. Soft objects: distance of the middles, and the largest difference of an extent.",
    reason="no plan predicts a final state that was localised or replayed",
)


def state_panels(states: Sequence[StateSummary]) -> tuple[Subject, list[Panel]]:
    """Return one panel for each kind of error that any state has."""
    final: dict[tuple[str, str], list[StateSummary]] = {}
    for state in states:
        if state.is_last:
            final.setdefault((state.predicted_by, state.against), []).append(state)
    panels = [
        Panel(label=label, groups=_groups(final, value), log=True)
        for label, value in (
            ("position error (mm)", lambda s: _scaled(s.position_m, 1000.0)),
            ("rotation error (°)", lambda s: _scaled(s.rotation_rad, 180.0 / math.pi)),
            ("error of the extents, soft objects (mm)", lambda s: _scaled(s.extents_m, 1000.0)),
        )
    ]
    return SUBJECT, panels


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _groups(
    states: Mapping[tuple[str, str], Sequence[StateSummary]],
    value: Callable[[StateSummary], float | None],
) -> tuple[Shares, ...]:
    found = []
    for predicted_by, against, name in PAIRS:
        errors = map(value, states.get((predicted_by, against), ()))
        values = [error for error in errors if error is not None]
        shares = shares_of(name, values)
        if shares is not None:
            found.append(shares)
    return tuple(found)
