"""Result files of other benchmarks as trials: SIMPLER, PolaRiS, LeRobot.

All three hold rollouts of a policy in a simulator, so the outcome goes to the sim side of a trial;
the recorded side stays unknown.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bridge.errors import PathNotFoundError
from bridge.exchange.table_text import TableError, read_rows
from bridge.exchange.trials_csv import TrialRecord

POLARIS_COLUMNS = ("episode", "episode_length", "success", "progress")
SIMPLER_NAME = re.compile(r"(success|failure)_obj_(.+)")
SIMPLER_STATISTIC = re.compile(r"_(?=[a-z])")
"""After the start, SIMPLER appends its episode statistics: ``_name_value`` each."""


def read_simpler(folder: Path) -> list[TrialRecord]:
    """Read the outcomes that SIMPLER writes into the names of its videos.

    ``<policy>/<scene>/<control>/<task>/rob_<pose>/success_obj_<start>_<statistics>.mp4``; folders
    that are not there stay empty. The start is the robot's pose and the object's.
    """
    if not folder.is_dir():
        hint = "Give the folder SIMPLER logged into."
        raise PathNotFoundError(path=folder, what="results folder", hint=hint)
    trials: dict[str, TrialRecord] = {}
    for path in sorted(folder.rglob("*.mp4")):
        name = SIMPLER_NAME.fullmatch(path.stem)
        if name is None:
            continue
        trial = _simpler_trial(path.relative_to(folder), name)
        if trial.trial_id in trials:
            raise TableError(
                path=path,
                row=None,
                found=f"start {trial.start_id} of {trial.task} has several videos",
                hint="Keep one result for each start, or give the folders one by one",
            )
        trials[trial.trial_id] = trial
    if not trials:
        raise TableError(
            path=folder,
            row=None,
            found="no video named success_obj_... or failure_obj_...",
            hint="Give a SIMPLER results folder, a run folder, or a table",
        )
    return list(trials.values())


def _simpler_trial(path: Path, name: re.Match[str]) -> TrialRecord:
    parts = path.parts[:-1]
    robot = parts[-1] if parts and parts[-1].startswith("rob_") else ""
    above = parts[:-1] if robot else parts
    start = name[2] if name[2].startswith("episode_") else SIMPLER_STATISTIC.split(name[2])[0]
    if name[2].startswith("episode_"):
        start = "_".join(name[2].split("_")[:2])
    start_id = "/".join(part for part in (robot, start) if part)
    return TrialRecord(
        trial_id="/".join((*parts, start)),
        task=above[-1] if above else "unnamed",
        policy=above[0] if len(above) > 1 else "",
        start_id=start_id,
        sim_planned=name[1] == "success",
        cell=above[1] if len(above) > 3 else "",
    )


def read_polaris(path: Path) -> list[TrialRecord]:
    """Read PolaRiS' ``eval_results.csv``: the task is the folder it lies in.

    ``success`` there is latched (ever reached); ``progress`` is partial credit, 0 to 1.
    """
    trials: dict[str, TrialRecord] = {}
    for row in read_rows(path, ("episode", "success"), POLARIS_COLUMNS):
        episode = row.whole("episode")
        if episode is None:
            raise row.refuse("episode is empty", "Every trial needs its number")
        success = row.answer("success")
        if success is None:
            raise row.refuse("success is empty", "PolaRiS writes True or False")
        task = path.resolve().parent.name
        trial_id = f"{task}/{episode}"
        if trial_id in trials:
            raise row.refuse(f"episode {episode} is there twice", "Remove the copy")
        trials[trial_id] = TrialRecord(
            trial_id=trial_id,
            task=task,
            start_id=str(episode),
            sim_planned=success,
            sim_progress=row.fraction("progress"),
        )
    return list(trials.values())


def read_lerobot_eval(path: Path) -> list[TrialRecord]:
    """Read LeRobot's ``eval_info.json`` of one task or several."""
    if not path.is_file():
        hint = "Give the eval_info.json that lerobot-eval wrote."
        raise PathNotFoundError(path=path, what="results file", hint=hint)
    try:
        record = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise TableError(
            path=path, row=None, found=f"no JSON ({error})", hint="Give an eval_info.json"
        ) from error
    try:
        trials = list(_lerobot_trials(record))
    except (KeyError, TypeError, AttributeError) as error:
        found = f"not as lerobot-eval writes it ({type(error).__name__} {error})"
        raise TableError(path=path, row=None, found=found, hint=_LEROBOT_HINT) from error
    if not trials:
        raise TableError(path=path, row=None, found="no outcomes", hint=_LEROBOT_HINT)
    name, times = Counter(trial.trial_id for trial in trials).most_common(1)[0]
    if times > 1:
        found = f"{name} is there {times} times"
        raise TableError(path=path, row=None, found=found, hint="Remove the copies")
    return trials


def _answer(value: object) -> bool:
    if not isinstance(value, bool):
        message = f"success {value!r} is not true or false"
        raise TypeError(message)
    return value


_LEROBOT_HINT = "Known are per_episode[].success, and per_task[].metrics.successes"


def _lerobot_trials(record: dict[str, Any]) -> Iterator[TrialRecord]:
    for item in record.get("per_episode", ()):
        number = item.get("episode_ix", item.get("episode_idx"))
        seed = item.get("seed")
        yield TrialRecord(
            trial_id=f"episode_{number}",
            task="lerobot",
            start_id=None if seed is None else str(seed),
            sim_planned=_answer(item["success"]),
        )
    for item in record.get("per_task", ()):
        task = f"{item['task_group']}/{item['task_id']}"
        for number, success in enumerate(item["metrics"]["successes"]):
            yield TrialRecord(
                trial_id=f"{task}/{number}",
                task=task,
                start_id=str(number),
                sim_planned=_answer(success),
            )
