"""Final object states as tables: medians per task, and every stage."""

from collections.abc import Sequence
from statistics import median

from evaluator.compare.in_tables import degrees, millimetre_ends, millimetres
from evaluator.compare.measure import slug
from evaluator.compare.states import StateSummary
from evaluator.result import Cell, Measurement, Table

Group = tuple[str, str, str, str]
"""Who predicts, what it is held against, task, condition."""


def state_id(key: Group) -> str:
    """Return the first part of a group's ids."""
    predicted_by, against, task, condition = key
    return f"state.{predicted_by}_to_{against}.{slug(task)}.{slug(condition)}"


def final_table(keys: Sequence[Group], by_id: dict[str, Measurement]) -> Table:
    """Medians of each group."""
    rows = []
    for key in keys:
        position = by_id[f"{state_id(key)}.position_median_m"]
        rotation = by_id.get(f"{state_id(key)}.rotation_median_rad")
        extents = by_id.get(f"{state_id(key)}.extents_median_m")
        rows.append(
            (
                key[2],
                key[3].replace("_", " "),
                key[0],
                key[1],
                position.n,
                millimetres(position.value),
                millimetre_ends(position.interval),
                millimetres(by_id[f"{state_id(key)}.position_mean_m"].value),
                None if rotation is None else degrees(rotation.value),
                None if extents is None else millimetres(extents.value),
            )
        )
    return Table(
        id="final_states",
        title="Predicted against final object states",
        columns=(
            "task",
            "condition",
            "predicted by",
            "against",
            "objects",
            "median distance (mm)",
            "interval (mm)",
            "mean distance (mm)",
            "median rotation (deg)",
            "median extents (mm)",
        ),
        rows=tuple(rows),
        note="After each object's last stage, when all has settled. plan: the poses the planner "
        "wrote into it; planned, executed: the dynamic replays; recorded: localised after the "
        "execution. Medians over episodes with 95 % intervals from order statistics; rotation is "
        "modulo symmetry; distance of soft objects is that of their middles.",
    )


def stage_table(states: Sequence[StateSummary]) -> Table:
    """Distances after each stage of each task and condition."""
    groups: dict[tuple[str, str, str, str, str], list[StateSummary]] = {}
    for state in states:
        key = (state.task, state.condition, state.stage, state.predicted_by, state.against)
        groups.setdefault(key, []).append(state)
    rows: list[tuple[Cell, ...]] = []
    for (task, condition, stage, predicted_by, against), members in groups.items():
        positions = [s.position_m for s in members if s.position_m is not None]
        turns = [s.rotation_rad for s in members if s.rotation_rad is not None]
        rows.append(
            (
                task,
                condition.replace("_", " "),
                stage,
                predicted_by,
                against,
                len(positions),
                millimetres(median(positions) if positions else None),
                millimetres(max(positions, default=None)),
                degrees(median(turns) if turns else None),
            )
        )
    return Table(
        id="stage_states",
        title="Object states after each stage",
        columns=(
            "task",
            "condition",
            "stage",
            "predicted by",
            "against",
            "objects",
            "median distance (mm)",
            "largest (mm)",
            "median rotation (deg)",
        ),
        rows=tuple(rows),
        note="Objects are localised only while nothing moves, so the recording is asked about the "
        "last stage of each object alone.",
    )
