"""Rollouts of one policy from many starts, and the table of all policies that were rolled out."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bridge.episode import streams
from bridge.episode.catalogue import find_episodes
from bridge.episode.catalogue_query import CatalogueQuery
from bridge.episode.metadata import CHECKPOINT_TAG, ROLLOUT, WITH, tagged
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, refuse_full
from bridge.errors import UsageError
from bridge.process_pool import Failed, runner_of
from bridge.terminal import Output
from bridge.whole_file import write_whole
from twin.policies.config import RolloutConfig, is_driven
from twin.policies.drive import drive_mapping
from twin.policies.mapping import read_mapping
from twin.policies.policy import HASHES
from twin.policies.rollout import RolloutJob, roll_out, row_of_file
from twin.policies.starts import trial_episodes
from twin.policies.variation import Quantity, describe_effect, effects, read_quantities

RESULTS = {"success": True, "failure": False}
"""Outcomes that count."""
TABLE = "rollouts.csv"
COLUMNS = (
    "trial_id",
    "task",
    "policy",
    "start_id",
    "recorded",
    "sim_planned",
    "stand_in",
    "checkpoint",
)
"""As ``robot-gst evaluate`` reads them; ``sim_planned`` is the rollout in the twin, and the
checkpoint who acted: the recorded trial's in a row of its own where it was another."""


def jobs_of(run: RunFolder, config: RolloutConfig) -> Iterator[RolloutJob]:
    """List the rollouts that are asked for."""
    episodes = trial_episodes(run, config.task)
    if is_driven(config.policy):
        mapping = drive_mapping(tuple(streams.camera_ids(episodes[0])))
    else:
        mapping = read_mapping(config.map)
    starts, vary = list(_starts(episodes, config.starts)), read_quantities(config.vary)
    _refuse_unknown(vary, {episode.path: episode for episode, _ in starts}.values())
    for episode, drawn in starts:
        for number in range(config.times):
            yield RolloutJob(
                run_path=run.path.resolve(),
                episode_path=episode.path.resolve(),
                drawn=drawn,
                seed=config.seed,
                number=number,
                policy=config.policy,
                name=config.name or config.policy,
                mapping=mapping,
                vary=vary,
                max_s=config.max_s,
                latency_s=config.latency_s,
                timeout_s=config.timeout_s,
            )


def _starts(episodes: Sequence[Episode], starts: str) -> Iterator[tuple[Episode, int | None]]:
    if starts == "recorded":
        yield from ((episode, None) for episode in episodes)
        return
    named = [e for e in episodes if starts in (e.info.start_id, e.info.id)]
    if named:
        yield from ((episode, None) for episode in named)
        return
    if not starts.isdigit() or not 1 <= int(starts) <= 10_000:
        there = ", ".join(e.info.start_id or e.info.id for e in episodes[:10])
        raise UsageError(
            f"--starts {starts!r} is neither 'recorded', nor a number from 1 to 10000, nor a start "
            f"of these trials: {there}"
        )
    first = {episode.info.task: episode for episode in reversed(episodes)}
    yield from ((episode, number) for episode in first.values() for number in range(int(starts)))


def roll_out_run(run: RunFolder, config: RolloutConfig, output: Output) -> dict[str, Any]:
    """Do what is not there yet, and write the table.

    Returns:
        ``rows`` of these rollouts and the ``table``.
    """
    run.refuse_empty()
    rows, todo = [], []
    workers = 1 if is_driven(config.policy) else config.workers
    jobs = list(jobs_of(run, config))
    for job in jobs:
        row = None if config.force else row_of_file(job.path())
        if row is None or row["problem"]:
            todo.append(job)
        else:
            rows.append(row)
    if todo:
        refuse_full(run.derived_dir)
    with output.progress("rollout", len(todo)) as advance, runner_of(workers) as runner:
        for done, (job, answer) in enumerate(runner.run(roll_out, todo, RolloutJob.cost), start=1):
            if isinstance(answer, Failed):
                output.detail(answer.trace)
                raise UsageError(f"{job.episode_path.stem}: {answer.message}")
            rows.append(answer)
            advance(done, job.episode_path.stem)
    rows.sort(key=lambda row: (row["task"], row["start_id"], row["number"]))
    found = {"run": str(run.path), "rows": rows, "table": str(write_table(run))}
    quantities = jobs[0].vary
    return {**found, "effects": list(effects(rows, quantities))} if quantities else found


def _refuse_unknown(vary: Sequence[Quantity], episodes: Iterable[Episode]) -> None:
    names = [item.name for item in vary if item.name.startswith("camera.")]
    for episode in episodes if names else ():
        known = streams.camera_ids(episode)
        for name in names:
            camera = name.split(".")[1]
            if camera not in known:
                raise UsageError(
                    f"--vary {name}: no camera {camera} in {episode.info.id}; it has: "
                    f"{', '.join(known) or 'none'}"
                )


def write_table(run: RunFolder) -> Path:
    """Write every rollout of a run beside what was recorded of the same policy from its start.

    Of several with other settings the newest counts.
    """
    recorded = _recorded(run)
    rows: dict[tuple[str, str], tuple[Any, ...]] = {}
    for path in sorted(run.derived(f"*.{ROLLOUT}.*"), key=lambda path: path.stat().st_mtime_ns):
        row = row_of_file(path)
        if row is None or row["success"] is None or row.get("varied"):
            continue
        key = (row["policy"], row["task"], row["start_id"])
        outcomes, number = recorded.get(key, []), row["number"]
        outcome, who = outcomes[number] if number < len(outcomes) else ("", "")  # each counts once
        name = f"{row['policy']} {row['start_id']} {number}"
        about = (row["task"], row["policy"], row["start_id"])
        stand_in, acted = str(row["stand_in"]).lower(), row.get("checkpoint", "")
        if acted.startswith(HASHES) and not who.startswith(HASHES):
            acted = f"{who} {acted}".strip()
        elif who and not f"{acted} ".startswith(f"{who} "):
            of_cell = f"{name} recorded"
            rows[row["task"], of_cell] = (of_cell, *about, outcome, "", stand_in, who)
            outcome = ""
        rows[row["task"], name] = (name, *about, outcome, int(row["success"]), stand_in, acted)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([COLUMNS, *sorted(rows.values())])
    path = run.path / TABLE
    write_whole(path, text.getvalue().encode())
    return path


def _recorded(run: RunFolder) -> dict[tuple[str, str, str], list[tuple[int | str, str]]]:
    """By policy, task and start: outcomes in the cell and who acted, not what replanning added."""
    found: dict[tuple[str, str, str], list[tuple[int | str, str]]] = {}
    for trial in find_episodes(run, CatalogueQuery(kind=("trial",), outcome=tuple(RESULTS))):
        if trial.condition != WITH:
            key = (trial.policy, trial.task, trial.start_id or trial.id)
            found.setdefault(key, []).append(
                (int(RESULTS[trial.outcome]), tagged(trial.tags, CHECKPOINT_TAG))
            )
    return found


def describe_rollouts(summary: Mapping[str, Any]) -> str:
    """What became of a policy, task by task, and what to do next."""
    rows: list[dict[str, Any]] = summary["rows"]
    lines = []
    for task in dict.fromkeys(row["task"] for row in rows):
        mine = [row for row in rows if row["task"] == task]
        judged = [row for row in mine if row["success"] is not None]
        done = sum(row["success"] for row in judged)
        stopped = sum(bool(row["stopped"]) for row in judged)
        line = f"{task or 'no start'}: {done} of {len(judged)} rollouts succeed"
        line += f", {stopped} stopped by a limit" if stopped else ""
        line += f"; {len(mine) - len(judged)} say nothing" if len(judged) < len(mine) else ""
        lines.append(line)
        lines += [f"  {row['start_id']}: {row['detail']}" for row in mine if not row["success"]]
    if "effects" in summary:
        told = [describe_effect(effect) for effect in summary["effects"]]
        return "\n".join([*lines, *(told or ["too few rollouts to tell what goes with failure"])])
    lines.append(f"next: robot-gst evaluate {summary['table']}")
    return "\n".join(lines)
