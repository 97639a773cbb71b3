"""What ``p_success`` is worth plan by plan in the laboratory ``lab_mixed``: docs/laboratory.md.

A session is one laboratory: its first starts are learned from, the later ones judged before any
trial, after one and after all of the first. Every plan is executed. Planner and twin see the
objects where the gate localises them in the cell's own images; nobody sees the truth topics.

    python benchmarks/bench_lab.py --folder runs/lab

Started again, anywhere, it goes on where it was; ``--report`` only prints what there is, and
``--development`` takes seeds that are no measurement.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from cell_run import FileSession, record_ungated
from measure import ROOT, Target, print_targets, report_targets

from bridge.episode.run_folder import RunFolder
from bridge.sources.standin.cell import StandinCell, TruthLog
from bridge.sources.standin.cell_file import draw_hidden, load_cell
from bridge.sources.standin.operator import execute_plan, label_trial
from bridge.sources.standin.streams import Streams
from bridge.task.find import chosen_task_file
from bridge.task.protocol import SEEDS_PER_SESSION
from bridge.task.task_file import Task, load_task
from bridge.terminal import Output
from evaluator.metrics.geometric_rule import judge_by_geometry
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.posterior import Trial, draw_beforehand, read_trials, weighed
from twin.gate.config import GateConfig
from twin.gate.gate import Gate, JudgedTasks, no_verdict
from twin.gate.live import LiveView
from twin.gate.service import serve_localisation
from twin.gate.twin_process import answer, asked, look
from twin.replay.config import PosteriorDraw
from twin.replay.monte_carlo import rigid_movers

TASKS = (
    "push_cube_to_mark",
    "stack_two_cubes",
    "slippery_block_into_box",
    "heavy_block_into_box",
)
"""Those of ``lab`` but the soft one, whose replays take seven times as long."""
CELL, WIRE = "lab_mixed", "lab"
FIRST, PER_TASK, DEVELOPMENT = 8208, 50, 1_000_200
KEPT = ROOT / "benchmarks" / "results" / "lab_mixed"
LEARNED, JUDGED = 4, 12
PLANNED, PAIRS = 28, 400
"""Sessions, and pairs of a good and a bad plan: with fewer a result is interim."""
SAMPLES, DRAWS = GateConfig().samples, CalibrateConfig().draws
RATE_HZ = 1.0
RESAMPLES = 2_000
QUIET = Output(quiet=True)
PARTS = {"before": 0, "one": 1, "four": LEARNED}
"""Of how many trials a forecast knows."""
FORECASTS = (*PARTS, "rule", "own engine", "first four", "base rate")
Session = dict[str, Any]


class SeeingSession(FileSession):
    """Writes episodes, and tells the planner where a gate that hears the same sees the objects."""

    def __init__(self, run: RunFolder, task: str) -> None:
        """Begin with nothing heard."""
        super().__init__(run.episodes_dir)
        self._served: dict[str, Callable[[bytes], bytes]] = {}
        self._view, config = LiveView(WIRE), GateConfig(cell=WIRE, task=task)
        gate = Gate(
            tasks=JudgedTasks(only=chosen_task_file(task)),
            config=config,
            perception=self._view,
            localise=lambda frames, task, ends_s: look((run.path, frames, task)),
            replay=lambda plan, *_: no_verdict(plan, "nobody judges here"),
            now_ns=self._view.newest_ns,
        )
        serve_localisation(self, gate, self._view, config, QUIET)

    def serve(self, key: str, answer: Callable[[bytes], bytes]) -> None:
        """Answer a query in this process."""
        self._served[key] = answer

    def write(self, topic: str, type_name: str, data: bytes, source_ns: int) -> None:
        """Into the open episode, and to the gate's eyes."""
        super().write(topic, type_name, data, source_ns)
        self._view.take(topic, data, source_ns, type_name)

    def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Play recorder and localiser."""
        if key in self._served:
            return self._served[key](payload)
        return super().query(key, payload, timeout_s=timeout_s)


def as_published(task: Task) -> StandinCell:
    """The cell's own engine in a laboratory that is what it says: friction, weight and force."""
    file = load_cell(CELL)
    hidden = replace(
        draw_hidden(file, file.development_seeds[0], task),
        finger_friction=0.80,
        object_friction=0.64,
        mass_scale=1.0,
        grip_N=task.grip_force_N or 20.0,
        joint_offset_rad=np.zeros(6),
        deviations=None,
    )
    unheard = Streams(FileSession(Path()), WIRE)
    return StandinCell(file, task, hidden, unheard, rate_hz=0.0, seed=0, start_ns=0)


def own_engine(cell: StandinCell, trial: Trial) -> bool:
    """Whether a plan succeeds in the cell's engine as published, objects where they are seen."""
    cell.reset(trial.scene.Ts_base_object)
    cell.wait(0.4)
    cell.truth = TruthLog()
    execute_plan(cell, trial.plan)
    outcome = label_trial(cell.task, cell.truth, executed=True, stopped=cell.stopped)
    return outcome.result == "success"


def p_success(run: RunFolder, trial: Trial, draws: Sequence[PosteriorDraw]) -> dict[str, Any]:
    """The verdict of a gate that knows these draws, with all of its samples."""
    question = asked(GateConfig(samples=SAMPLES), run.path, trial.plan, trial.scene)
    variation = replace(question.config.variation, posterior=tuple(draws))
    config = replace(question.config, variation=variation)
    verdict = answer(replace(question, config=config, until=None))
    causes = Counter(filter(None, (verdict.samples or {}).get("cause", ())))
    p = None if verdict.p_success is None else verdict.p_success["value"]
    return {"p": p, "accepted": verdict.accepted, "reason": verdict.reason, "causes": dict(causes)}


def judged(run: RunFolder, name: str, seed: int) -> Session:
    """What was said of each later plan, and what happened."""
    trials, not_used = read_trials(run, QUIET)
    start = [int(trial.info.start_seed or 0) % SEEDS_PER_SESSION for trial in trials]
    first = [trial for trial, number in zip(trials, start, strict=True) if number < LEARNED]
    task, draws = load_task(name), {}
    for part, count in PARTS.items():
        beforehand = draw_beforehand(DRAWS, rigid_movers(task)) if count else []
        learned = weighed(beforehand, first[:count], workers=1, output=QUIET) if count else []
        draws[part] = learned
    plain, rows = as_published(task), []
    for trial, number in zip(trials, start, strict=True):
        if number >= LEARNED:
            rule = judge_by_geometry(trial.plan, task, trial.scene.Ts_base_object).value
            said = {part: p_success(run, trial, draws[part]) for part in PARTS}
            own = own_engine(plain, trial)
            row = {"start": number, "success": trial.success, "rule": rule, "own engine": own}
            rows.append({**row, **said})
    done = [trial.success for trial in first]
    return {"task": name, "seed": seed, "not_used": not_used, "first": done, "rows": rows}


def session(folder: Path, task: str, seed: int, done: Path) -> Session:
    """Record and judge what is missing of a session."""
    path = folder / done.stem
    if not done.is_file():
        began_s = time.process_time()
        run = RunFolder.open(path) if path.is_dir() else RunFolder.create(path)
        sees, settings = SeeingSession(run, task), {"cell": WIRE, "rate_hz": RATE_HZ}
        record_ungated(run, task, seed, LEARNED + JUDGED, CELL, sees, **settings)
        found = judged(run, task, seed)
        found["cpu_s"] = round(time.process_time() - began_s, 1)
        done.write_text(json.dumps(found) + "\n")
        good = sum(row["success"] for row in found["rows"])
        print(f"{path.name}: {good} of {len(found['rows'])}, {found['cpu_s']} s CPU", flush=True)
    return dict(json.loads(done.read_text()))


def columns(sessions: Sequence[Session]) -> dict[str, np.ndarray]:
    """Per judged plan its session, its end, and every forecast; no verdict is one half."""
    rows = [{**row, "of": k} for k, each in enumerate(sessions) for row in each["rows"]]
    found = {name: np.array([row[name] for row in rows]) for name in ("of", "success")}
    for name in ("rule", "own engine"):
        found[name] = np.array([row[name] is True for row in rows], dtype=float)
    for part in PARTS:
        found[part] = np.array([0.5 if row[part]["p"] is None else row[part]["p"] for row in rows])
    again = np.array([(sum(each["first"]) + 1) / (len(each["first"]) + 2) for each in sessions])
    base = np.full(len(rows), found["success"].mean())
    return {**found, "first four": again[found["of"]], "base rate": base}


def ranked(success: np.ndarray, said: np.ndarray) -> tuple[float, int]:
    """In how many pairs of a good and a bad plan the good one is rated higher; ties are half."""
    above = np.sign(said[success][:, None] - said[~success][None, :])
    return float((above / 2 + 0.5).sum()), above.size


def statistics(found: dict[str, np.ndarray], picked: np.ndarray) -> dict[str, float]:
    """AUC within sessions, accuracy and Brier of every forecast; sessions may be taken twice."""
    members = [np.flatnonzero(found["of"] == k) for k in picked]
    rows, success, values = np.concatenate(members), found["success"], dict[str, float]()
    for name in FORECASTS:
        said = found[name]
        above = np.array([ranked(success[each], said[each]) for each in members]).sum(axis=0)
        values[f"AUC {name}"] = float(above[0] / above[1]) if above[1] else np.nan
        values[f"accuracy {name}"] = float(((said > 0.5) == success)[rows].mean())
        values[f"Brier {name}"] = float(np.mean((said - success)[rows] ** 2))
    for part in PARTS:
        shares = [[found[key][each].mean() for key in (part, "success")] for each in members]
        with np.errstate(invalid="ignore", divide="ignore"):
            values[f"r of sessions {part}"] = float(np.corrcoef(np.transpose(shares))[0, 1])
        for other, what in product(FORECASTS[len(PARTS) :], ("AUC", "accuracy", "Brier")):
            more = values[f"{what} {part}"] - values[f"{what} {other}"]
            values[f"{what} {part} minus {other}"] = more
    return values


def with_intervals(sessions: Sequence[Session]) -> dict[str, dict[str, float]]:
    """Every statistic with its 95 % interval: sessions resampled, within tasks that have more."""
    found, rng, table = columns(sessions), np.random.default_rng(0), {}
    strata = [[k for k, each in enumerate(sessions) if each["task"] == task] for task in TASKS]
    if min(map(len, strata)) < 2:  # one alone would not vary
        strata = [[*range(len(sessions))]]
    drawn = [
        statistics(found, np.concatenate([rng.choice(each, len(each)) for each in strata]))
        for _ in range(RESAMPLES)
    ]
    for name, value in statistics(found, np.arange(len(sessions))).items():
        low, high = np.nanpercentile([each[name] for each in drawn], [2.5, 97.5]).tolist()
        table[name] = {"value": value, "low": low, "high": high}
    return table


def targets(table: dict[str, dict[str, float]]) -> list[Target]:
    """What the laboratory is to show; r with its whole interval."""
    asked = [(f"AUC {part}", limit) for part, limit in zip(PARTS, (0.65, 0.75, 0.8), strict=True)]
    asked += [("accuracy four minus rule", 0.15), ("accuracy four minus first four", 0.08)]
    asked += [("r of sessions four", 0.7), ("Brier before minus base rate", 0.0)]
    return [
        Target(
            what=name,
            measured=table[name]["low" if name.startswith("r of") else "value"],
            limit=limit,
            at_most=name.startswith("Brier"),
            reference=f"[{table[name]['low']:.2f}, {table[name]['high']:.2f}]",
        )
        for name, limit in asked
    ]


def main() -> None:
    """Sessions of the tasks in turn, then the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=ROOT / "runs" / "lab_mixed")
    parser.add_argument("--sessions", type=int, default=7, help="of each task")
    parser.add_argument("--development", action="store_true")
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    first, found = DEVELOPMENT if given.development else FIRST, []
    for number in range(given.sessions):
        for task in TASKS:
            seed = first + PER_TASK * TASKS.index(task) + number
            done = (given.folder if given.development else KEPT) / f"{task}_{seed}.json"
            if not given.report or done.is_file():
                found.append(session(given.folder, task, seed, done))
    table = with_intervals(found)
    for name, value in table.items():
        print(f"{name:<40} {value['value']:6.2f} [{value['low']:.2f}, {value['high']:.2f}]")
    seen = columns(found)
    of = [seen["of"] == k for k in range(len(found))]
    num_pairs = sum(ranked(seen["success"][k], seen["rule"][k])[1] for k in of)
    interim = ": interim" * (len(found) < PLANNED or num_pairs < PAIRS)
    note = f"{CELL}, {len(found)} sessions, {len(seen['of'])} plans, {num_pairs} pairs{interim}"
    if given.development or interim:
        print(f"{note}{', development seeds' * given.development}")
        print_targets(targets(table))
    else:
        report_targets(CELL, targets(table), note=note, table=table, sessions=found)


if __name__ == "__main__":
    main()
