"""What an evaluation found as DataFrames: trials, groups, measurements.

    import evaluator

    groups = evaluator.read_groups("runs/monday")
    groups.pivot(index=["task", "condition"], columns="side", values="rate")

Unknown is ``pd.NA``, never "", 0 or False. Importing this module loads pandas.
"""

from collections.abc import Iterable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pandas as pd

from bridge.errors import PathNotFoundError
from bridge.exchange.trials_csv import TrialRecord, tags_text
from bridge.exchange.trials_csv import read_trials as read_csv
from evaluator.measurements import RATES, quantity_of
from evaluator.result import Measurement, load_results

INTERVAL = ("low", "high", "level", "method")
MEASUREMENT_TYPES = {
    "id": "string",
    "value": "Float64",
    "unit": "string",
    "better": "string",
    **dict.fromkeys(INTERVAL[:3], "Float64"),
    "method": "string",
    "k": "Int64",
    "n": "Int64",
    "counted": "string",
    "definition": "string",
    "reason_if_undefined": "string",
    "reason_without_interval": "string",
}
GROUP_TYPES = {
    **dict.fromkeys(("task", "condition", "policy", "side", "unit"), "string"),
    "k": "Int64",
    "n": "Int64",
    **dict.fromkeys(("rate", *INTERVAL[:3]), "Float64"),
    "method": "string",
    "reason_if_undefined": "string",
}
TRIAL_TYPES = {field.name: "string" for field in fields(TrialRecord)} | {
    **dict.fromkeys(("k", "n"), "Int64"),
    **dict.fromkeys(("recorded", "sim_planned", "sim_executed", "verdict", "stand_in"), "boolean"),
    **dict.fromkeys(("p_success", "progress", "sim_progress"), "Float64"),
}


def read_measurements(run: Path | str) -> pd.DataFrame:
    """Return one row per measured number of a run that was evaluated."""
    return measurements_frame(load_results(Path(run)).measurements)


def read_groups(run: Path | str) -> pd.DataFrame:
    """Return the success rates of a run: one row per task, condition, policy and side.

    Sides are ``recorded``, ``sim_planned``, ``sim_executed`` and ``verdict``; ``rate`` is from 0
    to 1 and ``unit`` what was counted. Names are written as ids spell them.
    """
    return groups_frame(load_results(Path(run)).measurements)


def read_trials(run: Path | str) -> pd.DataFrame:
    """Return one row per trial of a run that was evaluated, as ``trials.csv`` holds them."""
    path = Path(run)
    path = path / "results" / "trials.csv" if path.is_dir() else path
    if not path.is_file():
        hint = "Make them first: robot-gst evaluate RUN."
        raise PathNotFoundError(path=path, what="trials", hint=hint)
    rows = (asdict(trial) | {"tags": tags_text(trial.tags)} for trial in read_csv(path))
    return _frame(rows, TRIAL_TYPES)


def measurements_frame(measurements: Iterable[Measurement]) -> pd.DataFrame:
    """Lay measurements out, their intervals in columns."""
    return _frame((_row(measurement) for measurement in measurements), MEASUREMENT_TYPES)


def groups_frame(measurements: Iterable[Measurement]) -> pd.DataFrame:
    """Lay the success rates among some measurements out."""
    rows = []
    for measurement in measurements:
        for side, quantity in RATES.items():
            if found := quantity.pattern.fullmatch(measurement.id):
                row = {**_row(measurement), **found.groupdict(), "side": side}
                rows.append({**row, "rate": measurement.value, "unit": measurement.counted})
    return _frame(rows, GROUP_TYPES)


def _row(measurement: Measurement) -> dict[str, Any]:
    quantity = quantity_of(measurement.id)
    ends = {name: getattr(measurement.interval, name, None) for name in INTERVAL}
    return {**vars(measurement), **ends, "better": quantity.better if quantity else "none"}


def _frame(rows: Iterable[dict[str, Any]], kinds: dict[str, str]) -> pd.DataFrame:
    held = list(rows)
    return pd.DataFrame(
        {name: pd.array([row[name] for row in held], dtype=kind) for name, kind in kinds.items()}
    )
