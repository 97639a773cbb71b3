"""Trial by trial: does the twin agree with what happened, and do paired starts improve?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from evaluator.compare.measure import measured, proportion
from evaluator.compare.rows import TrialRow
from evaluator.compare.success import WITH, WITHOUT
from evaluator.errors import UndefinedStatisticError
from evaluator.result import Exclusion, Measurement
from evaluator.statistics.agreement import Confusion, mcnemar, phi

START_LIMIT_M = 0.03
"""Paired trials whose objects started further apart than this are not the same start."""


def agreement(rows: Sequence[TrialRow]) -> list[Measurement]:
    """Measure k/n agreement, phi and predictive values, of the replay and of the verdict."""
    measurements = []
    for name, said, words in (
        ("sim_planned", lambda row: row.sim_planned, "planned-in-twin (dynamic, of the sent plan)"),
        ("verdict", lambda row: row.verdict, "the verdict before motion"),
        ("sim_executed", lambda row: row.sim_executed, "executed-in-twin (diagnosis only)"),
    ):
        measurements.extend(_agreement_of(rows, name, said, words))
    if any(unheeded_verdict(row) is not None for row in rows):
        words = "the verdict before motion, recorded and not obeyed (without replanning)"
        measurements.extend(_agreement_of(rows, "verdict_unheeded", unheeded_verdict, words))
    return measurements


def unheeded_verdict(row: TrialRow) -> bool | None:
    """The gate's verdict where it decided nothing: a refused plan was executed all the same.

    Only these trials can show a false refusal, and only they are not selected by the gate.
    """
    return row.verdict if row.condition == WITHOUT else None


def heeded_verdict(row: TrialRow) -> bool | None:
    """The gate's verdict where it selected the plan: refused plans were never executed."""
    return row.verdict if row.condition == WITH else None


def _agreement_of(
    rows: Sequence[TrialRow], name: str, said: Callable[[TrialRow], bool | None], words: str
) -> list[Measurement]:
    seen = [
        (row.episode, answer, row.recorded)
        for row in rows
        if (answer := said(row)) is not None and row.recorded is not None
    ]
    episodes = [episode for episode, _, _ in seen]
    counts = Confusion.count((answer, happened) for _, answer, happened in seen)
    nothing = f"no trial has both {words} and a known outcome"
    return [
        proportion(
            f"agreement.{name}.rate",
            counts.agreed,
            counts.n,
            definition=f"trials where {words} and the labelled outcome say the same / trials",
            counted="trial",
            reason_if_undefined=nothing,
            episodes=episodes,
        ),
        measured(
            f"agreement.{name}.phi",
            lambda: phi(counts),
            unit="1",
            definition=f"phi coefficient of {words} and the labelled outcome over trials",
            n=counts.n,
            counted="trial",
            episodes=episodes,
        ),
        proportion(
            f"agreement.{name}.ppv",
            counts.true_positive,
            counts.said_success,
            definition=f"positive predictive value: trials that succeeded / trials where {words} "
            "said success",
            counted="trial",
            reason_if_undefined=nothing if not counts.n else "it never said success",
            episodes=[episode for episode, answer, _ in seen if answer],
        ),
        proportion(
            f"agreement.{name}.npv",
            counts.true_negative,
            counts.said_failure,
            definition=f"negative predictive value: trials that failed / trials where {words} "
            "said failure",
            counted="trial",
            reason_if_undefined=nothing if not counts.n else "it never said failure",
            episodes=[episode for episode, answer, _ in seen if not answer],
        ),
    ]


def confusion_of(rows: Sequence[TrialRow], said: Callable[[TrialRow], bool | None]) -> Confusion:
    """Count what was said against what was labelled, over trials where both are known."""
    return Confusion.count(
        (answer, row.recorded)
        for row in rows
        if (answer := said(row)) is not None and row.recorded is not None
    )


@dataclass(frozen=True, kw_only=True)
class StartPair:
    """The same start without and with replanning."""

    before: TrialRow
    after: TrialRow
    start_distance_m: float | None
    """Largest distance between the localised objects, None where they were not localised."""


def pair_starts(rows: Sequence[TrialRow]) -> tuple[list[StartPair], list[Exclusion]]:
    """Pair trials on task, policy and start_id; what cannot be paired is listed."""
    conditions = {row.condition for row in rows}
    if not {WITHOUT, WITH} <= conditions:
        return [], []
    groups: dict[tuple[str, str, str], list[TrialRow]] = {}
    left_out = []
    for row in rows:
        if row.condition not in (WITHOUT, WITH):
            continue
        if row.start_id is None:
            left_out.append(_out(row, "no start_id"))
        else:
            groups.setdefault((row.task, row.policy, row.start_id), []).append(row)
    pairs = []
    for (_, _, start_id), members in groups.items():
        before = [row for row in members if row.condition == WITHOUT]
        after = [row for row in members if row.condition == WITH]
        if len(before) != 1 or len(after) != 1:
            found = f"start {start_id} has {len(before)} without and {len(after)} with replanning"
            left_out.extend(_out(row, found) for row in members)
            continue
        distance_m = start_distance_m(before[0], after[0])
        if distance_m is not None and distance_m > START_LIMIT_M:
            found = (
                f"start {start_id}: localised objects {distance_m * 1000:.0f} mm apart, "
                f"limit {START_LIMIT_M * 1000:.0f} mm"
            )
            left_out.extend(_out(row, found) for row in members)
            continue
        pairs.append(StartPair(before=before[0], after=after[0], start_distance_m=distance_m))
    return pairs, left_out


def start_distance_m(first: TrialRow, second: TrialRow) -> float | None:
    """Return the largest distance between objects localised in both trials [m]."""
    shared = first.start_positions_m.keys() & second.start_positions_m.keys()
    if not shared:
        return None
    return max(
        float(
            np.linalg.norm(
                np.subtract(first.start_positions_m[name], second.start_positions_m[name])
            )
        )
        for name in shared
    )


def start_distances(pairs: Sequence[StartPair]) -> list[Measurement]:
    """Measure how far apart paired starts were, where both were localised."""
    known = [pair for pair in pairs if pair.start_distance_m is not None]
    distances = [pair.start_distance_m for pair in known if pair.start_distance_m is not None]
    unknown = len(pairs) - len(known)
    return [
        measured(
            f"paired.start_distance_{name}_m",
            partial(_summary_m, summary, distances),
            unit="m",
            definition=f"{name} over paired starts of the largest distance between the localised "
            f"objects of both trials; pairs beyond {START_LIMIT_M * 1000:.0f} mm are excluded, "
            f"{unknown} of {len(pairs)} pairs were not localised and are kept",
            n=len(known),
            counted="pair",
            reason_without_interval="the limit is what counts",
            episodes=[r.episode for pair in known for r in (pair.before, pair.after)],
        )
        for name, summary in (("mean", np.mean), ("max", np.max))
    ]


def _summary_m(summary: Callable[..., np.floating[Any]], distances: Sequence[float]) -> float:
    if not distances:
        raise UndefinedStatisticError(
            statistic="start distance", reason="no pair of starts was localised in both trials"
        )
    return float(summary(distances))


def paired_gain(pairs: Sequence[StartPair]) -> list[Measurement]:
    """Test the change with replanning on paired starts; only discordant pairs inform."""
    measurements = []
    for side in ("recorded", "sim_planned"):
        known = [
            pair
            for pair in pairs
            if getattr(pair.before, side) is not None and getattr(pair.after, side) is not None
        ]
        answers = [(getattr(pair.before, side), getattr(pair.after, side)) for pair in known]
        improved = sum(after and not before for before, after in answers)
        worsened = sum(before and not after for before, after in answers)
        words = f"{improved} improved, {worsened} worsened of {len(known)} paired starts ({side})"
        for kind in ("exact", "mid"):
            measurements.append(
                measured(
                    f"paired.mcnemar_p_{kind}.{side}",
                    lambda answers=answers, kind=kind: getattr(  # type: ignore[misc]
                        mcnemar(answers), f"p_{kind}"
                    ),
                    unit="1",
                    definition=f"two-sided McNemar test, {kind}"
                    f"{'-p' if kind == 'mid' else ' binomial'}: {words}",
                    n=len(known),
                    counted="pair",
                    episodes=[r.episode for pair in known for r in (pair.before, pair.after)],
                )
            )
    return measurements


def _out(row: TrialRow, reason: str) -> Exclusion:
    return Exclusion(episode=row.episode, scope="pairing of conditions", reason=reason)
