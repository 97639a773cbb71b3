"""Write a small invented run that has data for every part of an evaluation.

Three tasks, one rigid and two soft, without and with replanning. Each trial has a plan with
predicted final states, a verdict before motion with a sampled probability, stages, an outcome, a
localisation before and after, and a planned and an executed replay. Beside them: held-out views,
and imported runs without plans. Nothing here was measured: outcomes and errors are drawn from one
seed. On purpose one label contradicts the localised object, one object is not found, one verdict is
missing.

    python tests/golden/make_evaluation_run.py FOLDER
"""

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from evaluation_log import NUM_STEPS, START_NS, STEP_NS, Log, Trial, wobble
from evaluation_others import write_imported, write_views
from jaxtyping import Float

from bridge.episode import schema
from bridge.episode.metadata import Derived, EpisodeInfo, Outcome
from bridge.episode.provenance import hash_file
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.robots.default import ARM_JOINTS
from bridge.task.plan import Plan, Waypoint
from bridge.task.plan import Stage as PlanStage
from bridge.task.task_file import Task, load_task
from bridge.task.verdict import Factor, Verdict

SEED = 20240917
WITHOUT, WITH = "without_replanning", "with_replanning"
TRIALS = {"cube_into_box": 8, "sloth_into_basket": 4, "five_ducks_into_basket": 4}
"""Trials per condition; each start is tried in both."""
TRUTH = {WITHOUT: 0.55, WITH: 0.8}
"""How often a trial succeeds."""


def make_evaluation_run(folder: Path, *, trials: Mapping[str, int] | None = None) -> RunFolder:
    """Write the run into a new folder and return it."""
    rng = np.random.default_rng(SEED)
    run = RunFolder.create(folder)
    for name, count in (TRIALS if trials is None else trials).items():
        task = load_task(name)
        for condition in (WITHOUT, WITH):
            for start in range(1, count + 1):
                _write_trial(run, _draw(rng, task, condition, start), rng)
    write_views(run, rng)
    write_imported(run, rng)
    return run


def _draw(rng: np.random.Generator, task: Task, condition: str, start: int) -> Trial:
    several = len(task.manipulated)
    chance = float(np.clip(rng.normal(TRUTH[condition], 0.25), 0.05, 0.97))
    if several > 1:
        done = int(rng.binomial(several, 0.75 if condition == WITHOUT else 0.9))
        success = done == several
    else:
        success = bool(rng.random() < chance)
        done = int(success)
    said = success if rng.random() < 0.85 else not success
    trial = Trial(
        id=f"{task.name}_{'with' if condition == WITH else 'without'}_{start:02d}",
        task=task,
        condition=condition,
        start=start,
        success=success,
        done=done,
        said=said,
        executed=success if rng.random() < 0.95 else not success,
        p_success=round(float(np.clip(0.5 * chance + (0.45 if said else 0.05), 0, 1)), 2),
        label=success,
    )
    if task.name == "cube_into_box" and condition == WITHOUT and start == 1:
        return replace(trial, success=True, done=1, label=False)  # it lies in the box all the same
    if task.name == "cube_into_box" and condition == WITH and start == 2:
        return replace(trial, found=False)
    return trial


def _write_trial(run: RunFolder, trial: Trial, rng: np.random.Generator) -> None:
    starts, goals = _poses(trial, rng)
    plan = _plan(trial, goals)
    tool = _path(starts, goals, trial)
    joints = np.cumsum(rng.normal(0, 0.01, (NUM_STEPS, len(ARM_JOINTS))), axis=0)
    path = run.episodes_dir / f"{trial.id}.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(_info(trial, trial.id), outcome=_outcome(trial))
        log = Log(writer)
        log.raw("plan", schema.PLAN, plan.to_json(), START_NS - 3 * STEP_NS)
        if (trial.task.name, trial.start) != ("sloth_into_basket", 1):
            said = _verdict(trial, "planned").to_json()
            log.raw("verdict", schema.VERDICT, said, START_NS - STEP_NS)
        log.execution(plan)
        log.tool(tool + wobble(rng, 0.004))
        log.joints(joints + rng.normal(0, 0.002, joints.shape))
    sha256 = hash_file(path)
    ended = _ended(trial, starts, goals)
    localised = {name: p_m + rng.normal(0, 0.002, 3) for name, p_m in ended.items()}
    _write_localised(run, trial, sha256, starts, localised)
    for trajectory, offset, noise in (("planned", 0.0, 0.0), ("executed", 0.003, 0.0005)):
        said = trial.said if trajectory == "planned" else trial.executed
        left = _ended(replace(trial, success=said, done=trial.done if said else 0), starts, goals)
        near = {name: p_m + rng.normal(0, 0.004, 3) for name, p_m in left.items()}
        derived = Derived(
            kind="replay",
            source_episode=trial.id,
            source_sha256=sha256,
            plan_id=trial.plan_id,
            trajectory=trajectory,
            mode="dynamic",
            engine="gst",
            seed=trial.start,
        )
        name = f"{trial.id}.replay.{trajectory}.dynamic.{trial.plan_id}.gst.a"
        with EpisodeWriter(run.derived_dir / f"{name}.mcap") as writer:
            writer.describe(_info(trial, name.replace(".", "-")), derived=derived)
            log = Log(writer)
            log.execution(plan)
            log.tool(tool + offset + wobble(rng, noise))
            log.joints(joints + rng.normal(0, noise, joints.shape))
            log.objects(trial.task, starts, near)
            end_ns = START_NS + NUM_STEPS * STEP_NS
            log.raw("verdict", schema.VERDICT, _verdict(trial, trajectory).to_json(), end_ns)


def _info(trial: Trial, episode_id: str) -> EpisodeInfo:
    return EpisodeInfo(
        id=episode_id,
        kind="trial",
        task=trial.task.name,
        instruction=trial.task.instruction,
        condition=trial.condition,
        policy="scripted",
        start_id=f"s{trial.start}",
        start_seed=trial.start,
        robot="ur5",
        cell="standin",
        stand_in=True,
    )


def _outcome(trial: Trial) -> Outcome:
    several = len(trial.task.manipulated) > 1
    stages = [str(stage["id"]) for stage in trial.task.stages]
    passed = len(stages) * trial.done // len(trial.task.manipulated)
    passed = passed if trial.label or several else trial.start % len(stages)
    words = ["success"] * passed + ["failure"] * (passed < len(stages))
    words += ["unknown"] * (len(stages) - len(words))
    return Outcome(
        result="success" if trial.label else "failure",
        unit="object" if several else "trial",
        k=trial.done if several else int(trial.label),
        n=len(trial.task.manipulated),
        by="make_evaluation_run",
        stages=tuple({"id": i, "result": w} for i, w in zip(stages, words, strict=True)),
    )


def _poses(
    trial: Trial, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Where every object starts, and where the plan puts those it moves [m]."""
    place = np.random.default_rng(SEED + 7 * trial.start)  # the same start in both conditions
    starts: dict[str, np.ndarray] = {}
    for name, model in trial.task.objects.items():
        spread = trial.task.start[name]
        x, y = (place.uniform(*ends) for ends in (spread.x_m, spread.y_m))
        starts[name] = np.array([x, y, model.rest_height_m]) + rng.normal(0, 0.001, 3)
    container = starts[trial.task.containers[0]]

    def rest(name: str) -> float:
        return trial.task.objects[name].rest_height_m

    goals = {
        name: container + np.array([0.012 * i - 0.02, 0.01, 0.008 + rest(name)])
        for i, name in enumerate(trial.task.manipulated)
    }
    return starts, goals


def _ended(
    trial: Trial, starts: Mapping[str, np.ndarray], goals: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Where objects lie in the end: the first ``done`` where they belong, the others beside it."""
    found = dict(starts)
    for place, name in enumerate(trial.task.manipulated):
        beside = goals[name] + [0.0, -0.22, -0.008]
        found[name] = goals[name] if place < trial.done else beside
    return found


def _path(
    starts: Mapping[str, np.ndarray], goals: Mapping[str, np.ndarray], trial: Trial
) -> Float[np.ndarray, "num_steps 3"]:
    name = trial.task.manipulated[0]
    share = np.linspace(0, 1, NUM_STEPS)[:, None]
    lift = 0.18 * np.sin(np.pi * share)
    return starts[name] + share * (goals[name] - starts[name]) + lift * [0, 0, 1]


def _plan(trial: Trial, goals: Mapping[str, np.ndarray]) -> Plan:
    raw = trial.task.stages
    span = NUM_STEPS * STEP_NS // len(raw)
    stages = tuple(
        PlanStage(
            id=str(stage["id"]),
            text=str(stage["text"]),
            grasp=stage.get("grasp"),
            release=stage.get("release"),
            predicted_objects={
                name: {"p_m": goals[name].tolist(), "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
                for name in (stage.get("release"),)
                if name is not None
            },
            t_start_ns=i * span,
            t_end_ns=(i + 1) * span,
        )
        for i, stage in enumerate(raw)
    )
    tau = tuple(
        Waypoint(t_ns=i * STEP_NS, p_m=(0.5, 0.0, 0.2), q_wxyz=(1.0, 0.0, 0.0, 0.0), g=0)
        for i in range(2)
    )
    return Plan(
        id=trial.plan_id,
        planner="make_evaluation_run",
        policy="scripted",
        condition=trial.condition,
        robot="ur5",
        frame="base_link",
        instruction=trial.task.instruction,
        task=trial.task.name,
        start_id=f"s{trial.start}",
        stages=stages,
        tau=tau,
    )


def _verdict(trial: Trial, trajectory: str) -> Verdict:
    said = trial.said if trajectory == "planned" else trial.executed
    failing = None if said else ("clearance", "terminal", "ik")[trial.start % 3]
    factors = {
        "ik": Factor(value=False, first_t_ns=900_000_000, cause="unreachable"),
        "clearance": Factor(
            value=False,
            first_t_ns=1_400_000_000,
            cause="collision",
            bodies=("gripper", trial.task.containers[0]),
        ),
        "terminal": Factor(value=False, cause="inside", detail="it lies beside the container"),
    }
    return Verdict(
        plan_id=trial.plan_id,
        trajectory=trajectory,
        mode="dynamic",
        **{name: no if name == failing else Factor(value=True) for name, no in factors.items()},
        engine="gst",
        seed=trial.start,
        p_success={"value": trial.p_success} if trajectory == "planned" else None,
        findings=tuple(
            {
                "side": "replayed",
                "kind": kind,
                "object": name,
                "value": failing != "terminal" or kind != "inside",
                "detail": "drawn",
            }
            for name in trial.task.manipulated
            for kind in ("inside", "settled", "released", "allowed_contacts")
        ),
    )


def _write_localised(
    run: RunFolder,
    trial: Trial,
    sha256: str,
    starts: Mapping[str, np.ndarray],
    ended: Mapping[str, np.ndarray],
) -> None:
    derived = Derived(kind="localised", source_episode=trial.id, source_sha256=sha256)
    with EpisodeWriter(run.derived_dir / f"{trial.id}.localised.scene.mcap") as writer:
        writer.describe(_info(trial, f"{trial.id}-localised"), derived=derived)
        log = Log(writer)
        log.localised(trial, "start", starts, START_NS - 5 * STEP_NS)
        log.localised(trial, "end", ended, START_NS + (NUM_STEPS + 5) * STEP_NS)


if __name__ == "__main__":
    print(make_evaluation_run(Path(sys.argv[1])).path)
