"""What the gate's verdicts are worth in the laboratory: docs/laboratory.md has the protocol.

Records what is missing, session by session, tasks in turn, then prints the tables. Stopped with
Ctrl-C and started again it goes on; ``--report`` only prints what there is.

    python benchmarks/bench_lab_verdicts.py --folder runs/lab_verdicts --side-by-side 2
"""

import argparse
import json
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lab_cameras import PART, judge_again
from lab_session import LabSession, end_all
from measure import ROOT, Target, print_targets, report_targets

TASKS = (
    "push_cube_to_mark",
    "stack_two_cubes",
    "slippery_block_into_box",
    "heavy_block_into_box",
    "sloth_over_rim",
)
FIRST, PER_TASK = 8100, 10
"""Unused seeds; the development seeds of the cell are 1000000 to 1000999."""
RESAMPLES = 10_000
NAME = "lab_verdicts"
PARTS = {
    "before": "default settings",
    "after": "with the session's first four trials",
    PART: "the same, cameras calibrated",
}
RESULT = Path(os.environ.get("GST_BENCH_RESULTS", ROOT / "benchmarks" / "results"), NAME + ".json")
Rows = Sequence[dict[str, Any]]


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=ROOT / "runs" / "lab_verdicts")
    parser.add_argument("--tasks", nargs="*", default=list(TASKS), choices=TASKS)
    parser.add_argument("--sessions", type=int, default=PER_TASK, help="of each task")
    parser.add_argument("--development", type=int, metavar="SEED", help="first seed instead")
    parser.add_argument("--side-by-side", type=int, default=1)
    parser.add_argument("--report", action="store_true", help="record nothing")
    parser.add_argument(
        "--cameras", action="store_true", help="judge again with calibrated cameras, see item 6"
    )
    parser.add_argument("--store", action="store_true", help="keep the result, complete or not")
    return parser.parse_args(given)


def sessions_of(asked: argparse.Namespace) -> list[LabSession]:
    """Tasks in turn, so that what there is at any time is balanced."""
    found = []
    for number in range(asked.sessions):
        for task in asked.tasks:
            first = asked.development
            seed = FIRST + PER_TASK * TASKS.index(task) if first is None else first
            found.append(LabSession(task=task, seed=seed + number, folder=asked.folder))
    return found


def stored_rows() -> dict[tuple[str, int], list[dict[str, Any]]]:
    """Complete sessions of an interim result, whose recordings need not be there any more."""
    if not RESULT.is_file():
        return {}
    found: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in json.loads(RESULT.read_text())["rows"]:
        found.setdefault((row["task"], row["seed"]), []).append(row)
    return found


def record_all(sessions: Sequence[LabSession], side_by_side: int) -> None:
    """Record those that are not complete; one that fails does not stop the others."""
    todo: queue.SimpleQueue[LabSession] = queue.SimpleQueue()
    for session in sessions:
        todo.put(session)

    stopping = threading.Event()

    def work() -> None:
        while not stopping.is_set():
            try:
                session = todo.get_nowait()
            except queue.Empty:
                return
            try:
                session.record()
                print(f"{session.name}: complete", flush=True)
            except (subprocess.CalledProcessError, OSError) as error:
                print(f"{session.name}: {error}", flush=True)

    threads = [threading.Thread(target=work, daemon=True) for _ in range(side_by_side)]
    for sign in (signal.SIGINT, signal.SIGTERM):
        signal.signal(sign, signal.default_int_handler)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    except KeyboardInterrupt:
        stopping.set()
        end_all()
        raise


def complete(session: LabSession, found: Mapping[tuple[str, int], Any]) -> bool:
    """Whether a session is recorded, here or in the stored result."""
    return session.rows_file.is_file() or (session.task, session.seed) in found


def rows_of_session(
    session: LabSession, found: Mapping[tuple[str, int], list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """Rows of a complete session, from its folder where it is there."""
    if session.rows_file.is_file():
        rows: list[dict[str, Any]] = json.loads(session.rows_file.read_text())
        return rows
    return found[session.task, session.seed]


def judged(rows: Rows) -> Rows:
    """Trials with an outcome, a plan and a verdict that is yes or no."""
    return [row for row in rows if usable(row) and row["said"] is not None]


def usable(row: dict[str, Any]) -> bool:
    """Whether a plan was made, and an outcome is known."""
    return row["planned"] and row["happened"] in ("success", "failure")


def arrays(rows: Rows) -> dict[str, np.ndarray]:
    """Columns of judged trials, and the number of the session that is each one's cluster."""
    names = sorted({(row["task"], row["seed"]) for row in rows})
    return {
        "cluster": np.array([names.index((row["task"], row["seed"])) for row in rows], dtype=int),
        "task": np.array([TASKS.index(row["task"]) for row in rows], dtype=int),
        "said": np.array([row["said"] is True for row in rows], dtype=bool),
        "done": np.array([row["happened"] == "success" for row in rows], dtype=bool),
        "rule": np.array([row["geometry"] is True for row in rows], dtype=bool),
        "p": np.array(
            [np.nan if row["p_success"] is None else row["p_success"] for row in rows], dtype=float
        ),
        "again": np.array([row.get("again", np.nan) for row in rows], dtype=float),
    }


Columns = dict[str, np.ndarray]


def _share(part: np.ndarray, of: np.ndarray) -> float:
    return float(part[of].mean()) if of.any() else np.nan


STATISTICS: dict[str, Callable[[Columns], float]] = {
    "base rate": lambda c: float(c["done"].mean()),
    "accuracy": lambda c: float((c["said"] == c["done"]).mean()),
    "PPV": lambda c: _share(c["done"], c["said"]),
    "NPV": lambda c: _share(~c["done"], ~c["said"]),
    "good plans accepted": lambda c: _share(c["said"], c["done"]),
    "Brier": lambda c: float(np.mean((c["p"] - c["done"]) ** 2)),
    "Brier of the base rate": lambda c: float(c["done"].mean() * (1 - c["done"].mean())),
    "Brier, base rate minus gate": lambda c: (
        float(c["done"].mean() * (1 - c["done"].mean())) - float(np.mean((c["p"] - c["done"]) ** 2))
    ),
    "geometric rule, accuracy": lambda c: float((c["rule"] == c["done"]).mean()),
    "accuracy above the geometric rule": lambda c: float(
        (c["said"] == c["done"]).mean() - (c["rule"] == c["done"]).mean()
    ),
    "PPV above the base rate": lambda c: _share(c["done"], c["said"]) - float(c["done"].mean()),
    "as the session's first trials, accuracy": lambda c: float(
        np.mean(np.where(np.isnan(c["again"]), np.nan, (c["again"] >= 0.5) == c["done"]))
    ),
    "accuracy above the session's first trials": lambda c: float(
        np.mean((c["said"] == c["done"]).astype(float))
        - np.mean(np.where(np.isnan(c["again"]), np.nan, (c["again"] >= 0.5) == c["done"]))
    ),
    "Brier of the session's first trials": lambda c: float(np.mean((c["again"] - c["done"]) ** 2)),
}


def with_intervals(rows: Rows) -> dict[str, dict[str, float | None]]:
    """Every statistic with the percentile interval of resampled sessions, task by task."""
    columns = arrays(rows)
    clusters = np.unique(columns["cluster"])
    members = {key: np.flatnonzero(columns["cluster"] == key) for key in clusters}
    strata = [
        [key for key in clusters if columns["task"][members[key][0]] == task]
        for task in np.unique(columns["task"])
    ]
    rng = np.random.default_rng(0)
    values: dict[str, list[float]] = {name: [] for name in STATISTICS}
    enough = all(len(stratum) > 1 for stratum in strata)  # one alone would not vary
    for _ in range(RESAMPLES if enough else 0):
        drawn = [rng.choice(stratum, len(stratum)) for stratum in strata]
        pick = np.concatenate([members[key] for key in np.concatenate(drawn)])
        part = {name: column[pick] for name, column in columns.items()}
        for name, statistic in STATISTICS.items():
            values[name].append(statistic(part))
    found = {}
    for name, statistic in STATISTICS.items():
        kept = [value for value in values[name] if np.isfinite(value)]
        low, high = np.percentile(kept, [2.5, 97.5]).tolist() if kept else (None, None)
        value = statistic(columns)
        found[name] = {"value": value if np.isfinite(value) else None, "low": low, "high": high}
    return found


def table(rows: Rows) -> dict[str, Any]:
    """Counts, and every statistic."""
    ready = judged(rows)
    return {
        "trials": len(rows),
        "void": sum(row["happened"] not in ("success", "failure") for row in rows),
        "no plan": sum(
            not row["planned"] and row["happened"] in ("success", "failure") for row in rows
        ),
        "no verdict": sum(usable(row) and row["said"] is None for row in rows),
        "n": len(ready),
        "yes": sum(row["said"] is True for row in ready),
        "statistics": with_intervals(ready) if ready else {},
    }


def with_first_trials(rows: list[dict[str, Any]]) -> None:
    """Add to every later trial what share of its session's first ones succeeded."""
    for row in rows:
        if row["part"] == "before":
            continue
        first = [
            other["happened"] == "success"
            for other in rows
            if other["part"] == "before"
            and (other["task"], other["seed"]) == (row["task"], row["seed"])
            and other["happened"] in ("success", "failure")
        ]
        if first:  # as much towards the middle as two more trials, one of them good
            row["again"] = (sum(first) + 1) / (len(first) + 2)


def told(value: dict[str, float | None]) -> str:
    """A number with its interval."""
    if value["value"] is None:
        return "-"
    ends = "" if value["low"] is None else f" [{value['low']:.2f}, {value['high']:.2f}]"
    return f"{value['value']:.2f}{ends}"


def print_table(label: str, found: dict[str, Any]) -> None:
    """A few lines."""
    counts = ", ".join(f"{found[key]} {key}" for key in ("trials", "void", "no plan", "no verdict"))
    print(f"{label}: {counts}; n = {found['n']}, {found['yes']} yes")
    for name, value in found["statistics"].items():
        print(f"    {name:<44} {told(value)}")


def _target(
    label: str,
    what: str,
    found: dict[str, Any],
    limit: float,
    *,
    end: str = "value",
    at_most: bool = False,
) -> Target:
    measured = found[what][end]
    return Target(
        what=f"{label}: {what}" + ("" if end == "value" else ", lower end"),
        measured=float("nan") if measured is None else measured,
        limit=limit,
        at_most=at_most,
        reference=told(found[what]),
    )


def targets_of(label: str, tables: dict[str, dict[str, Any]]) -> list[Target]:
    """The targets of docs/laboratory.md."""
    pooled = tables["pooled"]["statistics"]
    rows = [
        _target(label, "accuracy above the geometric rule", pooled, 0.10),
        _target(label, "accuracy above the geometric rule", pooled, 1e-9, end="low"),
        _target(label, "PPV", pooled, 0.85),
        _target(label, "good plans accepted", pooled, 0.80),
        _target(label, "Brier", pooled, 0.15, at_most=True),
        _target(label, "Brier, base rate minus gate", pooled, 1e-9),
    ]
    for task in TASKS:
        if task in tables and tables[task]["statistics"]:
            one = _target(label, "PPV above the base rate", tables[task]["statistics"], 1e-9)
            rows.append(Target(**{**vars(one), "what": f"{label}: {task}: PPV above base rate"}))
    return rows


def main() -> None:
    """Record, then report."""
    asked = arguments()
    sessions = sessions_of(asked)
    known = stored_rows()
    if not asked.report:
        record_all([each for each in sessions if not complete(each, known)], asked.side_by_side)
    done = [session for session in sessions if complete(session, known)]
    rows = [row for session in done for row in rows_of_session(session, known)]
    there = {(row["task"], row["seed"]) for row in rows if row["part"] == PART}
    for session in done:
        judged_again = session.run / f"verdicts_{PART}.json"
        if (session.task, session.seed) not in there and (asked.cameras or judged_again.is_file()):
            rows += judge_again(session)
    with_first_trials(rows)
    targets, details = [], {}
    for part, label in PARTS.items():
        mine = [row for row in rows if row["part"] == part]
        if not mine:
            continue
        tables = {t: table([row for row in mine if row["task"] == t]) for t in asked.tasks}
        tables["pooled"] = table(mine)
        for name, found in tables.items():
            print_table(f"{name}, {label}", found)
        if tables["pooled"]["statistics"] and part != PART:
            targets += targets_of(label, tables)
        details[part] = tables
    whole = len(done) == len(sessions) == len(TASKS) * PER_TASK and asked.development is None
    note = (
        f"stand-in cell lab, {len(done)} of {len(sessions)} sessions"
        f"{'' if whole else ': INTERIM, not a result'}"
        f"{'' if asked.development is None else ', development seeds'}"
    )
    if whole or asked.store:
        report_targets(NAME, targets, note=note, complete=whole, parts=details, rows=rows)
    else:
        print(note)
        print_targets(targets)


if __name__ == "__main__":
    main()
