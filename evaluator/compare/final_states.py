"""How far objects end from where they were predicted to, per task, with and without replanning."""

from collections.abc import Callable, Sequence
from functools import partial
from statistics import median

from evaluator.compare.final_state_tables import Group, final_table, stage_table, state_id
from evaluator.compare.measure import interval_or_reason, measured
from evaluator.compare.part import Part
from evaluator.compare.states import EXECUTED, PAIRS, PLAN, PLANNED, RECORDED, StateSummary
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Exclusion, Interval, Measurement
from evaluator.statistics.bootstrap import student_interval
from evaluator.statistics.lengths import cluster_means, median_interval

WHO = {
    PLAN: "the plan's predicted pose",
    PLANNED: "the planned replay's",
    EXECUTED: "the executed replay's",
    RECORDED: "the localised recording's",
}
QUANTITIES: tuple[tuple[str, str, str, Callable[[StateSummary], float | None]], ...] = (
    ("position", "m", "distance of the object", lambda s: s.position_m),
    ("rotation", "rad", "angle modulo the object's symmetry", lambda s: s.rotation_rad),
    ("extents", "m", "largest difference of a soft object's extents", lambda s: s.extents_m),
)
UNKNOWN = {
    "position": "no position is known",
    "rotation": "the task file is not known, so neither is the symmetry",
    "extents": "not both sides know the shape",
}
"""Why a quantity has no value although its position has."""
MEAN_KEY = "student-t:length"
"""Coverage of Student's interval for lengths with now and then a miss."""
USE_MEDIAN = "the median with its interval"


def state_results(states: Sequence[StateSummary]) -> Part:
    """Measure final states per task and condition; each stage's goes into a table.

    Objects of one episode share its calibration and its start, so an episode counts once: the mean
    over its objects.
    """
    if not states:
        reason = "no plan that was sent predicts where a stage leaves its objects"
        return Part(missing=(f"final states: no data ({reason})",))
    groups: dict[Group, list[StateSummary]] = {}
    for state in states:
        if state.is_last:
            key = (state.predicted_by, state.against, state.task, state.condition)
            groups.setdefault(key, []).append(state)
    ordered = sorted(groups, key=lambda key: (key[2], key[3], PAIRS.index((key[0], key[1]))))
    measurements = [m for key in ordered for m in _measure(key, groups[key])]
    by_id = {measurement.id: measurement for measurement in measurements}
    return Part(
        measurements=tuple(measurements),
        tables=(final_table(ordered, by_id), stage_table(states)),
        exclusions=_left_out(states),
    )


def _measure(key: Group, states: Sequence[StateSummary]) -> list[Measurement]:
    predicted_by, against, task, condition = key
    found = []
    for name, unit, words, read in QUANTITIES:
        pairs = [(value, s.episode) for s in states if (value := read(s)) is not None]
        if name == "extents" and (predicted_by == PLAN or not any(s.soft for s in states)):
            continue  # a plan predicts a pose and no shape
        values, episodes = [value for value, _ in pairs], [episode for _, episode in pairs]
        of_episode = cluster_means(values, episodes)
        about = f"{words} after its last stage, {WHO[predicted_by]} against {WHO[against]}, in "
        about += f"{task}, {condition.replace('_', ' ')}"
        make = partial(
            measured,
            unit=unit,
            n=len(values),
            counted="object",
            episodes=list(dict.fromkeys(episodes)),
            interval_n=len(of_episode),
        )
        found.append(
            make(
                f"{state_id(key)}.{name}_median_{unit}",
                partial(_median, of_episode, states, name),
                definition=f"{about}: median over {len(of_episode)} episodes of each one's mean "
                "over its objects",
                reason_without_interval=interval_or_reason(median_interval, of_episode)[1],
            )
        )
        if name == "position":
            found.append(
                make(
                    f"{state_id(key)}.{name}_mean_{unit}",
                    partial(_mean, of_episode, states, name),
                    definition=f"{about}: mean over {len(of_episode)} episodes of each one's mean "
                    "over its objects",
                    reason_without_interval=interval_or_reason(student_interval, of_episode)[1],
                    coverage_key=MEAN_KEY,
                    instead=USE_MEDIAN,
                )
            )
    return found


def _median(
    values: Sequence[float], states: Sequence[StateSummary], quantity: str
) -> float | tuple[float, Interval | None]:
    _some(values, states, quantity)
    return float(median(values)), interval_or_reason(median_interval, values)[0]


def _mean(
    values: Sequence[float], states: Sequence[StateSummary], quantity: str
) -> float | tuple[float, Interval | None]:
    _some(values, states, quantity)
    return sum(values) / len(values), interval_or_reason(student_interval, values)[0]


def _some(values: Sequence[float], states: Sequence[StateSummary], quantity: str) -> None:
    if values:
        return
    reasons = {state.reason for state in states if state.reason}
    raise UndefinedStatisticError(
        statistic="final state", reason="; ".join(sorted(reasons)) or UNKNOWN[quantity]
    )


def _left_out(states: Sequence[StateSummary]) -> tuple[Exclusion, ...]:
    found = {
        (state.episode, f"{state.object_id}: {state.reason}"): None
        for state in states
        if state.reason is not None and state.is_last
    }
    return tuple(
        Exclusion(episode=episode, scope="final states", reason=reason) for episode, reason in found
    )
