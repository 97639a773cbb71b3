"""What the gate's yes and no are worth on the stand-in cell, judged against what really happened.

Every plan of the scripted planner is executed, whatever the gate would have said, so that the truth
is known for all of them. Each is then judged by the gate itself (localisation, replay, deadline, in
its own process) from exactly what a live gate had seen when the plan came: the recorded messages
before it. The truth topics are never shown to it. One session is one laboratory; 4 trials each.

Goes on where it was interrupted: recordings and verdicts are kept in --folder. Without
--development it uses seeds that nobody looked at before, and stores the result of all tasks.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measure import ROOT, Target, print_targets, report_targets

from bridge.episode.topics import is_truth

TASKS = {
    "cube_into_box": "standin",
    "sloth_into_basket": "standin_toys",
    "five_ducks_into_basket": "standin_toys_steady",
}
"""Tasks and their cells."""
PER_SESSION = 4
FRESH, DEVELOPMENT = {"standin": 500, "standin_toys": 500, "standin_toys_steady": 520}, 60
"""First session seed; the development seeds of the cell are 0 to 99."""
RESAMPLES = 10_000
CAMERAS_AND_FRAMES = ("/tf", "/tf_static", "/robot_description")


@dataclass(frozen=True)
class Judged:
    """One trial: what the gate said beforehand, and what happened."""

    task: str
    said: bool | None
    succeeded: bool
    objects: tuple[tuple[bool | None, bool], ...]
    """Per manipulated object of a task with several: said, and done in the end."""
    seconds: float
    reason: str | None


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trials", nargs="?", type=int, default=40, help="per task")
    parser.add_argument("--tasks", nargs="*", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--cell", choices=list(FRESH), help="another cell for all of them")
    parser.add_argument("--development", action="store_true")
    parser.add_argument("--samples", type=int, default=0)
    parser.add_argument("--min-p-success", type=float, default=0.0)
    parser.add_argument("--deadline", type=float, default=120.0)
    parser.add_argument("--folder", type=Path, default=ROOT / "runs" / "bench_replay_gate")
    return parser.parse_args()


def judge_task(task_name: str, options: argparse.Namespace) -> list[Judged]:
    """Record and judge one task's trials, as far as they are not there yet."""
    from cell_run import record_ungated

    from bridge.episode.run_folder import RunFolder
    from bridge.terminal import Output
    from twin.gate.config import GateConfig
    from twin.gate.twin_process import TwinProcess

    cell = options.cell or TASKS[task_name]
    first = DEVELOPMENT if options.development else FRESH[cell]
    config = GateConfig(
        task=task_name,
        deadline_s=options.deadline,
        samples=options.samples,
        min_p_success=options.min_p_success,
    )
    judged = []
    for session in range(-(-options.trials // PER_SESSION)):
        seed = first + session
        folder = options.folder / cell / task_name / f"seed_{seed}"
        run = RunFolder.open(folder) if folder.is_dir() else RunFolder.create(folder)
        paths = record_ungated(run, task_name, seed, PER_SESSION, cell)
        todo = options.trials - len(judged)
        with TwinProcess(run.path, config, Output(quiet=True)) as twin:
            judged += [judge_trial(run, path, config, twin) for path in paths[:todo]]
    return judged


def judge_trial(run: Any, path: Path, config: Any, twin: Any) -> Judged:
    """Ask the gate about one recorded trial, or read what it said before."""
    from bridge.episode.provenance import hash_settings
    from bridge.episode.reader import Episode
    from twin.replay.job import REPLAY_VERSION
    from twin.scene.store.calibration import read_calibration

    settings = {"config": repr(config), "replay_version": REPLAY_VERSION}
    calibration = read_calibration(run)
    if calibration is not None:
        settings["calibration_id"] = calibration.calibration_id
    kept = path.with_suffix(f".{hash_settings(settings)}.json")
    if not kept.is_file():
        verdict, seconds = ask(Episode.open(path), config, twin, calibration)
        kept.write_text(json.dumps({"verdict": json.loads(verdict.to_json()), "seconds": seconds}))
    said = json.loads(kept.read_text())
    return compare(Episode.open(path), said["verdict"], config.task, said["seconds"])


def ask(episode: Any, config: Any, twin: Any, calibration: Any = None) -> tuple[Any, float]:
    """Let the gate see what came before the plan, and judge it."""
    from bridge.episode import streams
    from bridge.task.find import chosen_task_file
    from twin.gate.gate import Gate, JudgedTasks
    from twin.gate.live import LiveView

    ((stamp_ns, plan),) = streams.plans(episode)
    perception = LiveView(config.cell, calibration)
    for message in episode.messages():
        if message.log_time_ns >= stamp_ns:  # the execution begins with the same stamp
            break
        watched = message.topic in CAMERAS_AND_FRAMES or message.topic.startswith(
            (f"/{config.cell}/cam/", f"/{config.cell}/event", f"/{config.cell}/joint_states")
        )
        if watched and not is_truth(message.topic):
            perception.take(message.topic, message.data, message.log_time_ns, message.type_name)
    tasks = JudgedTasks(only=chosen_task_file(config.task))
    calls = {"localise": twin.localise, "replay": twin.replay, "now_ns": lambda: stamp_ns}
    gate = Gate(tasks=tasks, config=config, perception=perception, **calls)
    before = time.monotonic()
    return gate.judge(plan.to_json()), time.monotonic() - before


def compare(episode: Any, verdict: dict[str, Any], task_name: str, seconds: float) -> Judged:
    """Put a verdict beside what the operator saw."""
    from bridge.episode.metadata import Outcome
    from bridge.task.task_file import load_task

    outcome: Outcome = episode.outcome
    task = load_task(task_name)
    objects: list[tuple[bool | None, bool]] = []
    if len(task.manipulated) > 1:
        done = {stage["id"]: stage["result"] == "success" for stage in outcome.stages}
        for name in task.manipulated:
            release = next(stage["id"] for stage in task.stages if stage.get("release") == name)
            objects.append((said_of(verdict, name), done[release]))
    return Judged(
        task=task_name,
        said=verdict["accepted"],
        succeeded=outcome.result == "success",
        objects=tuple(objects),
        seconds=seconds,
        reason=verdict["reason"],
    )


def said_of(verdict: dict[str, Any], name: str) -> bool | None:
    """What the replay found of one object; a plan that fails otherwise says nothing good of it."""
    values = [
        item["value"]
        for item in verdict.get("findings") or []
        if item.get("object") == name and item.get("side") == "replayed"
    ]
    if not values or verdict["ik"]["value"] is not True:
        return None
    if False in values:
        return False
    return None if None in values else True


def tables(label: str, pairs: Sequence[tuple[bool | None, bool]]) -> tuple[list[Target], dict]:
    """Predictive values with intervals, and what they are compared with."""
    from evaluator.statistics.intervals import wilson

    yes = [truth for said, truth in pairs if said is True]
    no = [truth for said, truth in pairs if said is False]
    good = [said is True for said, truth in pairs if truth]
    base = sum(truth for _, truth in pairs)

    def share(k: int, n: int) -> dict[str, Any]:
        if n == 0:
            return {"k": 0, "n": 0, "value": None, "reason": "no trial"}
        interval = wilson(k, n)
        return {"k": k, "n": n, "value": k / n, "low": interval.low, "high": interval.high}

    found = {
        "base_rate": share(base, len(pairs)),
        "ppv": share(sum(yes), len(yes)),
        "npv": share(len(no) - sum(no), len(no)),
        "good_plans_accepted": share(sum(good), len(good)),
        "undecided": sum(said is None for said, _ in pairs),
        "ppv_above_base_rate": lift(pairs),
    }
    print(f"  {label}: " + "; ".join(f"{key} {told(value)}" for key, value in found.items()))
    low = found["ppv_above_base_rate"]["low"]
    reference = f"base rate {told(found['base_rate'])}, PPV {told(found['ppv'])}"
    nan = float("nan")
    rows = [
        Target(what=f"{label}: PPV above the base rate, lower end", limit=1e-6, at_most=False,
               measured=nan if low is None else low, reference=reference),
    ]  # fmt: skip
    return rows, found


def lift(pairs: Sequence[tuple[bool | None, bool]]) -> dict[str, Any]:
    """PPV minus base rate with the percentile interval of 10,000 resampled sets of trials."""
    said = np.array([value is True for value, _ in pairs])
    truth = np.array([value for _, value in pairs])
    rng = np.random.default_rng(0)
    values = []
    for _ in range(RESAMPLES):
        pick = rng.integers(0, len(truth), len(truth))
        if said[pick].any():
            values.append(truth[pick][said[pick]].mean() - truth[pick].mean())
    if not said.any():
        return {"value": None, "low": None, "high": None, "reason": "nothing was accepted"}
    low, high = np.percentile(values, [2.5, 97.5])
    value = float(truth[said].mean() - truth.mean())
    return {"value": value, "low": float(low), "high": float(high)}


def told(value: Any) -> str:
    """A share in a few words."""
    if not isinstance(value, dict):
        return str(value)
    if value["value"] is None:
        return f"undefined ({value['reason']})"
    count = f" ({value['k']}/{value['n']})" if "n" in value else ""
    return f"{value['value']:.2f}{count} [{value['low']:.2f}, {value['high']:.2f}]"


def main() -> None:
    """Every task, then all of them together."""
    options = arguments()
    judged: list[Judged] = []
    targets, details = [], {}
    for task in options.tasks:
        mine = judge_task(task, options)
        judged += mine
        rows, details[task] = tables(task, [(item.said, item.succeeded) for item in mine])
        targets += rows
        single = [pair for item in mine for pair in item.objects]
        if single:
            _, details[f"{task}, single objects"] = tables(f"{task}, single objects", single)
        for item in mine:
            if item.said is None:
                print(f"    no verdict: {item.reason}")
    _, pooled = tables("all tasks", [(item.said, item.succeeded) for item in judged])
    nan = float("nan")
    ppv, good = pooled["ppv"]["value"], pooled["good_plans_accepted"]["value"]
    targets += [
        Target(what="all tasks: PPV", measured=nan if ppv is None else ppv, limit=0.85,
               at_most=False, reference=f"base rate {told(pooled['base_rate'])}"),
        Target(what="all tasks: good plans accepted", measured=nan if good is None else good,
               limit=0.70, at_most=False, reference=told(pooled["good_plans_accepted"])),
    ]  # fmt: skip
    seconds = [item.seconds for item in judged]
    seeds = "development" if options.development else "unused"
    whole = not options.development and not options.cell and set(options.tasks) == set(TASKS)
    note = (
        f"{len(judged)} stand-in trials, {seeds} seeds, {PER_SESSION} for each laboratory, all "
        f"executed; {options.samples} samples; a verdict in {np.median(seconds):.1f} s (median), "
        f"{max(seconds):.1f} s at most"
    )
    if whole:
        report_targets("replay_gate", targets, note=note, tasks={**details, "all tasks": pooled})
    else:
        print(note)
        print_targets(targets)


if __name__ == "__main__":
    main()
