"""What an evaluation found as DataFrames: trials, groups, measurements.

    import evaluator

    groups = evaluator.read_groups("runs/monday")
    groups.pivot(index=["task", "condition"], columns="side", values="rate")

Unknown is ``pd.NA``, never "", 0 or False. Importing this module loads pandas.
"""

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from bridge.errors import PathNotFoundError
from bridge.exchange.trials_csv import read_trials as read_csv
from bridge.exchange.trials_csv import tags_text
from evaluator.columns import INTERVAL, OF_MEASUREMENTS, OF_TRIALS
from evaluator.measurements import RATES, quantity_of
from evaluator.result import Measurement, load_results

MEASUREMENT_TYPES = OF_MEASUREMENTS | {"better": str}
GROUP_TYPES = {
    **dict.fromkeys(("task", "condition", "policy", "side", "unit"), str),
    **dict.fromkeys(("k", "n"), int),
    **dict.fromkeys(("rate", *INTERVAL[:3]), float),
    **dict.fromkeys(("method", "reason_if_undefined"), str),
}
DTYPES: dict[type, str] = {str: "string", int: "Int64", float: "Float64", bool: "boolean"}


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
    return _frame(rows, OF_TRIALS)


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
    ends |= {"better": quantity.better if quantity else "none"}
    return {**vars(measurement), **ends, "episodes": " ".join(measurement.episodes)}


def _frame(rows: Iterable[dict[str, Any]], kinds: dict[str, type]) -> pd.DataFrame:
    held = list(rows)
    return pd.DataFrame(
        {
            name: pd.array([row[name] for row in held], dtype=DTYPES[kind])
            for name, kind in kinds.items()
        }
    )
