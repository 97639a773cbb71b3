"""One plan from words to a verdict: the recorded start, candidates, what the twin says of each."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode import streams
from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode
from bridge.episode.run_folder import PLAN_REPLAY, REFUSED_PLAN, RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.episode.topics import ROBOT_DESCRIPTION
from bridge.errors import EpisodeError, GstError, UsageError
from bridge.geometry import se3
from bridge.robots.robot import read_robot, robot_of
from bridge.task.check import nearest
from bridge.task.model_policy import MODEL_POLICY
from bridge.task.plan import Plan, Stage
from bridge.task.plan_request import Refusal
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from bridge.whole_file import write_whole
from twin.errors import TwinError
from twin.plan.config import PlanConfig
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.ground.run_tasks import UnderstoodTask, names_task, shown_task_file, understand
from twin.plan.loop.nominal import NOMINAL, PlanProposer
from twin.plan.loop.propose import Attempt, plan_and_verify
from twin.plan.loop.steer import tool_at, tried_in
from twin.plan.loop.tau import goals_of
from twin.plan.missed import missed_before
from twin.plan.model_goals import Asked, ask_for_goals
from twin.plan.problem import NoPlanError, Pose, Problem, State
from twin.plan.shapes import problem_of
from twin.plan.usable_start import refuse_other_robot, refuse_unusable
from twin.replay.config import ReplayConfig
from twin.replay.output import ReplayOrigin, write_replay
from twin.replay.rebuilt_scene import for_task
from twin.replay.run_job import cell_of, recorded_joints
from twin.replay.verdict import replay_plan
from twin.scene.localise.episode import localise_episode
from twin.scene.localise.mesh_fit import scanned_surfaces
from twin.scene.localise.result import LocalisedObject
from twin.scene.localise.stationary_frames import calibrated_cameras, stationary_frames
from twin.scene.store.calibration import read_calibration


@dataclass(frozen=True, kw_only=True)
class Start:
    """What was recorded before anything moved."""

    episode: Episode
    seen_ns: int
    """When the last of its objects was seen [ns]."""
    localised: Mapping[str, LocalisedObject]
    problem: Problem

    @property
    def arm(self) -> str:
        """Where plans begin, in words."""
        if self.problem.scene.start_rad is not None:
            return "as recorded"
        return "its home posture, for nobody recorded all its joints within 1 s"

    def lines(self) -> list[str]:
        """Where each object is, how sure, and by what."""
        found = [f"start: as recorded at the beginning of {self.episode.path.stem}"]
        for key, item in self.localised.items():
            if item.T_base_object is None:
                continue
            x, y, z = item.T_base_object[:3, 3] * 1e3
            sure = "nobody says how sure"
            if item.covariance is not None:
                sigma = np.sqrt(np.linalg.eigvalsh(item.covariance[:3, :3]).max()) * 1e3
                sure = f"to {sigma:.1f} mm"
            shape = self.problem.shapes[key].source
            found.append(
                f"  {key}: ({x:.0f}, {y:.0f}, {z:.0f}) mm {sure}, by {item.method}; shape: {shape}"
            )
        found.append(f"  arm: {self.arm}")
        scene = self.problem.scene.scene_hash
        found.append(f"  scene: {'none was rebuilt' if scene is None else scene[:12]}")
        return found


def start_of(run: RunFolder, task: Task, config: PlanConfig, robot: str = "") -> Start:
    """Localise a task's objects at the start of the newest episode that shows them all."""
    run.refuse_empty()
    paths = run.episodes()
    if config.episode:
        names = {path.stem: path for path in paths}
        if config.episode not in names:
            message = (
                f"{run.path} has no episode {config.episode!r}. There are: {', '.join(names)}."
                f"{nearest(config.episode, names)}"
            )
            raise UsageError(message)
        paths = [names[config.episode]]
    lacking = ""
    episodes = [Episode.open(path) for path in paths]
    for episode in sorted(episodes, key=lambda each: streams.first_stamp_ns(each) or 0)[::-1]:
        path = episode.path
        surfaces = scanned_surfaces(run, task).surfaces
        poses = calibrated_cameras(episode, read_calibration(run))
        found = localise_episode(episode, task, surfaces=surfaces, poses=poses)
        missing = {
            key: item.reason or "not found"
            for key, item in found.items()
            if item.T_base_object is None
        }
        if not missing:
            return _start(run, episode, task, found, robot)
        why = ", ".join(f"{key} ({reason})" for key, reason in missing.items())
        lacking = lacking or f"{why} in {path.stem}"
    if config.episode:
        hint = "Name another --episode, or none for the newest that shows all"
    else:
        hint = f"No older episode shows all: record again: robot-gst record {run.path}"
    raise NoPlanError(f"not localised: {lacking}; task {task.name} needs it. {hint}.")


def _start(
    run: RunFolder, episode: Episode, task: Task, found: Mapping[str, LocalisedObject], robot: str
) -> Start:
    urdf = streams.robot_description(episode)
    if robot:
        urdf = read_robot(robot).description()
    if urdf is None:
        raise EpisodeError(
            path=episode.path,
            found="no robot description",
            hint=f"Record {ROBOT_DESCRIPTION}, or name the robot file: --robot.",
        )
    seen_ns = max(item.stamp_ns for item in found.values())
    start_rad = recorded_joints(episode, seen_ns, robot_of(urdf).joints)
    poses = {key: T for key, item in found.items() if (T := item.T_base_object) is not None}
    sure = {key: item.covariance for key, item in found.items() if item.covariance is not None}
    problem = problem_of(run, task, urdf, poses, sure, start_rad)
    if not robot:
        refuse_other_robot(run, problem.robot.record)
    refuse_unusable(problem)
    return Start(episode=episode, seen_ns=seen_ns, localised=found, problem=problem)


@dataclass(frozen=True, kw_only=True)
class Begun:
    """The task, from where, and what a model said of it."""

    understood: UnderstoodTask
    start: Start
    asked: Asked | None = None

    def lines(self) -> list[str]:
        """Everything for a person."""
        asked = [] if self.asked is None else ["", *self.asked.lines()]
        return [*self.understood.lines(), "", *self.start.lines(), *asked]

    def to_json(self) -> dict[str, Any]:
        """The same as data."""
        return {
            **self.understood.to_json(),
            "start": {"episode": self.start.episode.path.stem, "arm": self.start.arm},
            "model": None if self.asked is None else self.asked.to_json(),
        }


def begin(run: RunFolder, words: str, config: PlanConfig, robot: str = "") -> Begun:
    """Find out what is to be done and from where; a model is asked first where one is given."""
    understood = None if config.model and not names_task(words) else understand(run, words)
    file = shown_task_file(run, config.episode) if understood is None else understood.file
    start = start_of(run, file.task(), config, robot)
    if understood is not None and not config.model:
        return Begun(understood=understood, start=start)
    asked = ask_for_goals(
        run,
        words if understood is None else file.task().instruction,
        start.problem,
        config,
        file,
        is_fixed=understood is not None,
        frames=_start_frames(run, start),
    )
    start = replace(start, problem=asked.problem)
    return Begun(understood=asked.understood, start=start, asked=asked)


def _start_frames(run: RunFolder, start: Start) -> list[RgbdFrame]:
    """What each camera saw last before anything moved; nothing where there were none."""
    try:
        poses = calibrated_cameras(start.episode, read_calibration(run))
        return stationary_frames(start.episode, 1, before_ns=start.seen_ns + 1, poses=poses)
    except GstError:
        return []


@dataclass(frozen=True, kw_only=True)
class Planned:
    """What came of an instruction."""

    begun: Begun
    """With what a model said, as far as plans keep it."""
    attempts: Sequence[Attempt]
    path: Path | None

    @property
    def last(self) -> Attempt:
        """The attempt that counts."""
        return self.attempts[-1]

    def lines(self) -> list[str]:
        """Everything for a person."""
        told = [*self.begun.lines(), "", "constraints:"]
        told += [*self.explained(), "", "candidates:"]
        told += [f"  {_attempt_line(each)}" for each in self.attempts]
        told += ["", "where the numbers come from:"]
        told += [f"  {remark}" for remark in self.last.candidate.remarks]
        verdict = self.last.verdict
        told += [f"  the twin: {text}" for text in verdict.warnings]
        if self.path is not None:
            told += ["", f"wrote {self.path}"]
        else:
            told += ["", "no candidate was accepted; nothing was sent"]
        return told

    def to_json(self) -> dict[str, Any]:
        """The same as data."""
        return {
            **self.begun.to_json(),
            "plan": None if self.path is None else str(self.path),
            "attempts": [
                {
                    "id": each.candidate.plan.id,
                    "cost": each.candidate.cost,
                    "remarks": list(each.candidate.remarks),
                    "verdict": json.loads(each.verdict.to_json()),
                }
                for each in self.attempts
            ],
            "constraints": self.explained(),
        }

    def explained(self) -> list[str]:
        """Each stage with its constraints."""
        problem, plan = self.begun.start.problem, self.last.candidate.plan
        return [line for stage in plan.stages for line in _explained(problem, plan, stage)]


def plan_once(
    run: RunFolder, begun: Begun, judge: Callable[[Plan], Verdict], config: PlanConfig
) -> Planned:
    """Propose, have the twin judge, steer, until a plan is accepted; write each with its replay.

    The first is steered by the newest trial of the task, if that failed.
    """
    before = missed_before(run, begun.start.problem.scene.task, begun.understood.file.sha256)
    attempts = _attempts(begun, judge, config, before)
    paths = [_kept(run, begun.start, each) for each in attempts]
    path = paths[-1] if attempts[-1].verdict.accepted is True else None
    return Planned(begun=begun, attempts=attempts, path=path)


def _kept(run: RunFolder, start: Start, attempt: Attempt) -> Path:
    """Write a plan, and beside it the twin's replay of it; return where the plan lies."""
    plan, verdict = attempt.candidate.plan, attempt.verdict
    run.plans_dir.mkdir(exist_ok=True)
    ending = ".json" if verdict.accepted is True else REFUSED_PLAN
    path = run.plans_dir / f"{plan.id}{ending}"
    write_whole(path, plan.to_json())
    scene, episode = start.problem.scene, start.episode
    config = for_task(ReplayConfig(mode="dynamic"), read_calibration(run), scene.task)
    result = replace(replay_plan(plan, scene, config), verdict=verdict)
    replay_path = run.plans_dir / f"{plan.id}{PLAN_REPLAY}"
    replay_path.unlink(missing_ok=True)
    origin = ReplayOrigin(
        info=replace(
            episode.info,
            task=scene.task.name,
            task_sha256=plan.task_sha256,
            instruction=plan.instruction,
            policy=plan.policy,
        ),
        derived=Derived(
            kind="replay",
            source_episode=episode.info.id,
            source_sha256=episode.sha256(),
            plan_id=plan.id,
            trajectory="planned",
            mode="dynamic",
            scene_hash=scene.scene_hash,
            engine=verdict.engine,
            seed=config.seed,
            calibration_id=scene.calibration_id,
        ),
        cell=cell_of(episode),
        start_ns=start.seen_ns,
        urdf=scene.urdf,
        stages=plan.stages,
        end_ns=plan.tau[-1].t_ns,
    )
    write_replay(replay_path, result, plan, origin)
    return path


def _attempts(
    begun: Begun,
    judge: Callable[[Plan], Verdict],
    config: PlanConfig,
    before: Sequence[Refusal],
) -> list[Attempt]:
    policy, answer = NOMINAL, ""
    if begun.asked is not None:
        policy = MODEL_POLICY
        kept = json.dumps(begun.start.problem.scene.task.stages)
        answer = f"_{hashlib.sha256(kept.encode()).hexdigest()[:8]}"
    name, start = begun.understood.file.task().name, begun.start.episode.path.stem
    return plan_and_verify(
        PlanProposer(policy),
        begun.start.problem,
        judge,
        plan_id=f"{name}.{start}.{policy}{answer}.{config.seed}",
        seed=config.seed,
        rounds=config.rounds,
        refused=before,
        task_sha256=begun.understood.file.sha256,
        grounding_source="" if begun.asked is None else begun.asked.source,
    )


def _attempt_line(attempt: Attempt) -> str:
    plan, verdict = attempt.candidate.plan, attempt.verdict
    answer = {True: "accepted", False: "refused", None: "undecided"}[verdict.accepted]
    steered = "" if plan.steered_by is None else f", steered by {plan.steered_by.clause}"
    failing = verdict.first_failing
    factor = verdict.factors()[failing] if failing else None
    cause = "" if factor is None else f" by {failing}.{factor.cause}: {factor.detail}"
    if verdict.accepted is None and verdict.reason:
        cause = f": {verdict.reason}"
    return (
        f"{plan.id}: rank {attempt.candidate.rank}, J {attempt.candidate.cost:.4f}, "
        f"{plan.tau[-1].t_ns * 1e-9:.1f} s{steered}; {answer}{cause}"
    )


def _explained(problem: Problem, plan: Plan, stage: Stage) -> list[str]:
    """A stage with its constraints, at the instant that each of them speaks of."""
    told = [f"  {stage.id}: {stage.text}"]
    goals = goals_of(problem.scene.task, str(stage.release or stage.push))
    then = "as the hand closes" if stage.grasp else "as the hand opens" if stage.release else "then"
    for number, record in enumerate((*stage.subgoal, *stage.path)):
        try:
            constraint = compile_constraint(record, problem)
        except (UsageError, TwinError) as error:
            told.append(f"    {record.get('kind')}: {error}")
            continue
        start = State.single(problem.scene.Ts_base_object, tool_at(plan.tau[0]), 0.0)
        if number >= len(stage.subgoal):
            told.append(f"    kept on the way: {constraint.wanted(start)}")
            continue
        at_rest = number < len(goals)
        state = _state(problem, plan, stage, at_rest=at_rest)
        told.append(f"    {'at rest' if at_rest else then}: {constraint.explain(state)}")
    return told


def _state(problem: Problem, plan: Plan, stage: Stage, *, at_rest: bool) -> State:
    """What a plan predicts where the hand turns in a stage, else of its end; or at rest."""
    Ts: dict[str, Pose] = dict(problem.scene.Ts_base_object)
    until = plan.stages[: plan.stages.index(stage) + 1]
    for each in until if at_rest else until[:-1]:
        Ts |= {key: se3.pose_from_record(T) for key, T in each.predicted_objects.items()}
    inside = [w for w in plan.tau if stage.t_start_ns <= w.t_ns <= stage.t_end_ns]
    turned = [now for before, now in pairwise(inside) if before.g != now.g]
    at = [*inside, *turned][-1]
    held = [each.grasp for each in until if each.grasp is not None][-1:]
    for tried in tried_in(plan):
        if tried.object_id in held and not at_rest:  # it moves with the tool
            Ts[tried.object_id] = tool_at(at) @ se3.invert(tried.T_object_tcp)
    return State.single(Ts, tool_at(at), at.width_m or 0.0)
