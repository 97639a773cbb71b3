"""The session: an operator who records a scan, then trials, with the planner and the gate."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.metadata import (
    CONDITION_OF,
    RETRY,
    RETRY_OF_TAG,
    STUDY_ARM_TAG,
    WITH,
    WITHOUT,
    EpisodeInfo,
    Outcome,
    study_arm_of,
)
from bridge.episode.topics import STOPPED_BY_OPERATOR
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.robots.default import MAX_WIDTH_M, ROBOT_NAME
from bridge.sources.standin.cell import StandinCell, StoppedError, TruthLog
from bridge.sources.standin.decisions import Decider
from bridge.sources.standin.driven import Controller
from bridge.sources.standin.scan import joint_move, scan_joints
from bridge.sources.standin.settings import INTERRUPTED, POLICY, SessionConfig
from bridge.sources.standin.streams import Session
from bridge.task.plan import Plan
from bridge.task.predicate import all_hold, evaluate_success, objects_done
from bridge.task.protocol import SEEDS_PER_SESSION, arms_in_order
from bridge.task.task_file import Task, TaskFile
from bridge.terminal import Output

OPERATOR = "stand-in operator"
LIFTED_M = 0.05
"""An object that rose this far at any time was grasped."""
RESULTS = {True: "success", False: "failure", None: "unknown"}


def label_trial(
    task: Task, truth: TruthLog, *, executed: bool, remark: str = "", stopped: str = ""
) -> Outcome:
    """Say how a trial ended, as a person would from looking; one that a limit stopped is a failure.

    A task with several objects is counted by object: k of n are where they belong.
    """
    rollout = truth.rollout()
    findings = evaluate_success(task, rollout)
    verdict = all_hold(findings)
    done = objects_done(findings, task.manipulated)
    several = len(task.manipulated) > 1
    # With several objects only what went wrong is worth reading.
    told = [item for item in findings if not several or item.value is not True]
    detail = "; ".join(finding.detail for finding in told) or "every object is where it belongs"
    result, remark = RESULTS[False if stopped else verdict], stopped or remark
    return Outcome(
        result=result,
        unit="object" if several else "trial",
        k=sum(value is True for value in done.values()) if several else int(result == "success"),
        n=len(task.manipulated),
        by=OPERATOR,
        detail=f"{remark}: {detail}" if remark else detail,
        stages=tuple(
            {"id": stage["id"], "result": RESULTS[_stage_result(stage, task, truth, done, verdict)]}
            for stage in (task.stages if executed else ())
        ),
    )


def void_trial(task: Task, reason: str) -> Outcome:
    """Outcome of a trial in which nothing was executed because nobody answered."""
    count = len(task.manipulated)
    unit = "object" if count > 1 else "trial"
    return Outcome(result="unknown", unit=unit, k=0, n=count, by=OPERATOR, detail=reason)


def _stage_result(
    stage: Mapping[str, Any],
    task: Task,
    truth: TruthLog,
    done: Mapping[str, bool | None],
    verdict: bool | None,
) -> bool | None:
    if stage.get("grasp"):
        heights = [float(T[2, 3]) for T in truth.poses[stage["grasp"]]]
        return max(heights) - heights[0] > LIFTED_M
    if stage.get("carry"):
        goal = task.goal_of(stage["carry"])
        targets = task.containers if goal is None else (goal[1],)
        if goal is not None and (goal[0] not in ("inside", "on") or goal[1] not in task.objects):
            return None  # nothing to be above
        return any(_above(truth.poses[stage["carry"]], truth, task, key) for key in targets)
    placed = stage.get("release") or stage.get("push")
    return done[placed] if placed else verdict


def _above(
    Ts_base_object: list[Float[np.ndarray, "4 4"]], truth: TruthLog, task: Task, target_id: str
) -> bool:
    """Whether an object was ever over a container's cavity, or a support, higher than its top."""
    target = task.objects[target_id]
    half = np.array(target.inner_m[:2]) / 2
    T_target_base = se3.invert(truth.poses[target_id][0])
    p = se3.apply(T_target_base, np.array([T[:3, 3] for T in Ts_base_object]))
    top_m = target.size_m[2] - target.rest_height_m
    over = np.all(np.abs(p[:, :2]) < half, axis=1) & (p[:, 2] > top_m)
    return bool(over.any())


STILL_S = 0.16
"""The arm rests this long at a viewpoint before the picture."""


def wait_s(least_s: float, rate_hz: float) -> float:
    """How long the arm waits: each camera sees all that lies still at least once.

    An image counts only with some rest before and after it. A gate that has none waits for one,
    and the cell's clock stands still meanwhile, so none would come. At 0 Hz nobody looks.
    """
    return least_s if rate_hz <= 0 else max(least_s, 1 / rate_hz + 2 * STILL_S)


SETTLE_S = 0.8
"""The arm waits after a plan at least this long, so that the final state is seen at rest."""


def execute_plan(cell: StandinCell, plan: Plan) -> None:
    """Move as ``joints_rad`` says; events mark the plan, its stages and the gripper."""
    streams = cell.streams
    times = plan.times_ns()
    joints = np.array([waypoint.joints_rad for waypoint in plan.tau], dtype=np.float64)
    streams.event("execution_started", cell.now_ns, plan_id=plan.id)
    stage_id: str | None = None
    gripper: tuple[int, float | None] | None = None
    for first, last in _pieces(plan):
        if cell.stopped:
            break
        stage = plan.stage_at(int(times[first]))
        if stage is not None and stage.id != stage_id:
            _end_stage(cell, plan, stage_id)
            stage_id = stage.id
            streams.event("stage_started", cell.now_ns, plan_id=plan.id, stage_id=stage_id)
        waypoint = plan.tau[last]
        if (waypoint.g, waypoint.width_m) != gripper:
            g, width = gripper = (waypoint.g, waypoint.width_m)
            cell.grip((0.0 if g else MAX_WIDTH_M) if width is None else width)
            streams.event(
                "gripper",
                cell.now_ns,
                plan_id=plan.id,
                text="close" if g else "open",
                data={"width_m": width},
            )
        cell.follow(times[first : last + 1] - times[first], joints[first : last + 1])
    _end_stage(cell, plan, stage_id)
    streams.event("execution_ended", cell.now_ns, plan_id=plan.id)
    cell.wait(wait_s(SETTLE_S, cell.rate_hz))


def _end_stage(cell: StandinCell, plan: Plan, stage_id: str | None) -> None:
    if stage_id is not None:
        cell.streams.event("stage_ended", cell.now_ns, plan_id=plan.id, stage_id=stage_id)


def _pieces(plan: Plan) -> list[tuple[int, int]]:
    """Cut the trajectory where the gripper's command or the stage changes.

    A waypoint's ``g`` and width hold for the time before it: the piece that ends there runs under
    them.
    """
    times = plan.times_ns()
    stages = [plan.stage_at(int(t)) for t in times]
    cuts = [0]
    for k in range(1, len(plan.tau) - 1):
        after, here = plan.tau[k + 1], plan.tau[k]
        gripper_changes = (after.g, after.width_m) != (here.g, here.width_m)
        stage_changes = stages[k] is not stages[k - 1]
        if gripper_changes or stage_changes:
            cuts.append(k)
    cuts.append(len(plan.tau) - 1)
    return list(pairwise(cuts))


RESET_STREAM = 404
RESETS = {WITHOUT: 0, WITH: 1, "without": 0, "with": 1, "control": 3}
RESET_OF_A_SCAN = 2
RESETS_OF_RETRIES = 10
"""Added to the number of the first one's, so that the objects are put back independently."""
RETRY_SEEDS = 10**13
"""Added to a start's seed, so that what is drawn for a retry is drawn for no trial."""
LOOK_S = 0.9
"""The arm waits at home before a plan at least this long, so that the start is seen at rest."""
BETWEEN_S = 8.0
"""Putting the objects back takes a person about this long; nothing is published meanwhile."""
CONTROL_TIMEOUT_S = 300.0
LISTED = 1000
"""As many episodes as a recorder lists at once."""


@dataclass(frozen=True, kw_only=True)
class Treatment:
    """What is done with a start."""

    condition: str
    study_arm: str = ""
    """Empty outside a study."""

    @property
    def name(self) -> str:
        """The study arm, or the condition where there is none."""
        return self.study_arm or self.condition

    @property
    def tags(self) -> tuple[str, ...]:
        """Of its episode."""
        return (f"{STUDY_ARM_TAG}{self.study_arm}",) if self.study_arm else ()


class Operator:
    """Runs one session against a recorder and, with replanning, a gate."""

    def __init__(
        self,
        cell: StandinCell,
        session: Session,
        config: SessionConfig,
        output: Output | None = None,
        task_file: TaskFile | None = None,
    ) -> None:
        """Prepare; nothing is published before ``scan`` or ``trials``."""
        self._cell, self._session, self._config = cell, session, config
        self._output = output or Output(quiet=True)
        self._sent = {} if task_file is None else {"task_file": task_file.data.decode()}
        sha256 = "" if task_file is None else task_file.sha256
        self._decider = Decider(cell, session, config, sha256)
        driven = config.planner == POLICY
        self._controller = Controller(cell, session, config.cell, config.policy) if driven else None
        self._open = False
        self.scanned = False
        self.results: list[tuple[EpisodeInfo, Outcome]] = []
        self.retries: list[tuple[EpisodeInfo, Outcome]] = []

    def start_seeds(self, count: int) -> list[int]:
        """One seed per start; both conditions share them."""
        first = self._config.seed * SEEDS_PER_SESSION + self._config.first_start
        return [first + k for k in range(count)]

    def _recorded(self) -> list[dict[str, Any]]:
        """The run's episodes as the recorder lists them."""
        answer = self._control("list", {})
        episodes: list[dict[str, Any]] = answer["episodes"]
        if self._config.missing and answer["of"] > len(episodes):
            message = (
                f"--missing needs the list of all {answer['of']} episodes, and the recorder lists "
                f"{LISTED}. Record the other trials into another run."
            )
            raise UsageError(message)
        return episodes

    def _next_number(self, kind: str) -> int:
        """The number after the highest that the run's episodes of this kind have."""
        names = [re.fullmatch(rf"{kind}_(\d+)", item["id"]) for item in self._recorded()]
        return 1 + max((int(found[1]) for found in names if found), default=0)

    def _treatments(self, start_seed: int) -> list[Treatment]:
        """How a start is to be tried, in order; a study draws the order of its arms per start."""
        config = self._config
        if not config.study_arms:
            return [Treatment(condition=condition) for condition in config.conditions]
        arms = arms_in_order(config.study_arms, config.study_seed, start_seed)
        return [Treatment(condition=CONDITION_OF[arm], study_arm=arm) for arm in arms]

    def _wanted(self) -> list[tuple[int, Treatment]]:
        """Start seed and treatment of each trial to record."""
        config, task, policy = self._config, self._cell.task.name, self._decider.policy
        all_ = [(s, t) for s in self.start_seeds(config.trials) for t in self._treatments(s)]
        if not config.missing:
            return all_
        tried = set()
        for item in self._recorded():
            name = study_arm_of(item["tags"]) if config.study_arms else item["condition"]
            tried.add((item["start_id"], name, item["policy"]))
        return [(s, t) for s, t in all_ if (f"{task}/{s}", t.name, policy) not in tried]

    def start_poses(
        self, start_seed: int, treatment: str, *, retry: bool = False
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """The declared start as a person puts it down: a little off, differently each time.

        The deviations differ between treatments (conditions or study arms), and again in a retry.
        """
        noise = self._cell.file.noise_for(self._cell.task.name)
        poses = self._cell.task.draw_start(np.random.default_rng(start_seed))
        index = RESETS.get(treatment, RESET_OF_A_SCAN) + (RESETS_OF_RETRIES if retry else 0)
        rng = np.random.default_rng([RESET_STREAM, start_seed, index])
        for T in poses.values():
            turn = rng.normal(0.0, noise.reset_rad)
            T[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, turn])) @ T[:3, :3]
            T[:2, 3] += rng.normal(0.0, noise.reset_m, 2)
        return poses

    def scan(self) -> None:
        """Record one scan with the objects where the first trial has them."""
        cell, start_seed = self._cell, self.start_seeds(1)[0]
        cell.take_objects(start_seed)
        scan_id = f"scan_{self._next_number('scan'):04d}"
        cell.reset(self.start_poses(start_seed, "scan"))
        self._begin(self._info(scan_id, kind="scan", start_seed=start_seed))
        joints = cell.home_rad
        mount = next(item for item in cell.file.cameras.values() if item.moving)
        cell.wait(STILL_S)
        cell.capture()
        stops = scan_joints(mount, cell.kinematics, joints)
        with self._output.progress("scan", len(stops)) as advance:
            for done, target in enumerate(stops, start=1):
                self._move(joints, target)
                cell.wait(STILL_S)
                cell.capture()
                joints = target
                advance(done, "viewpoints")
        self._move(joints, cell.home_rad)
        cell.wait(STILL_S)
        self._end(None)
        self.scanned = True

    def _move(self, start: Float[np.ndarray, "6"], end: Float[np.ndarray, "6"]) -> None:
        times, joints = joint_move(start, end, self._cell.file.max_joint_speed_rad_s)
        self._cell.follow(times, joints)

    def trials(self) -> None:
        """Record every trial: each start once per condition; ``results`` grows."""
        wanted, first = self._wanted(), self._config.first_trial
        if wanted and first is None:
            first = self._next_number("trial")
        with self._output.progress("trials", len(wanted)) as advance:
            for number, (start_seed, treatment) in enumerate(wanted, start=first or 0):
                info, outcome = self._trial(number, start_seed, treatment)
                self.results.append((info, outcome))
                self._output.detail(f"{info.id} {treatment.name}: {outcome.result}")
                advance(len(self.results), f"{info.id} {outcome.result}")

    def _trial(
        self, number: int, start_seed: int, treatment: Treatment
    ) -> tuple[EpisodeInfo, Outcome]:
        info = self._info(
            f"trial_{number:04d}",
            kind="trial",
            condition=treatment.condition,
            policy=self._decider.policy,
            trial=number,
            start_id=f"{self._cell.task.name}/{start_seed}",
            start_seed=start_seed,
            tags=treatment.tags,
        )
        outcome = self._attempt(info, treatment, start_seed)
        if self._config.retry and outcome.is_failed_execution:
            tags = (*info.tags, f"{RETRY_OF_TAG}{info.id}")
            again = replace(info, id=f"{RETRY}_{number:04d}", kind=RETRY, tags=tags)
            second = self._attempt(again, treatment, start_seed + RETRY_SEEDS)
            self.retries.append((again, second))
            self._output.detail(f"{again.id} {treatment.name}: {second.result}")
        return info, outcome

    def _attempt(self, info: EpisodeInfo, treatment: Treatment, seed: int) -> Outcome:
        """Put the objects down, look, plan, execute and label, in an episode."""
        cell, retry = self._cell, info.kind == RETRY
        cell.take_objects(info.start_seed or 0)
        cell.reset(self.start_poses(info.start_seed or 0, treatment.name, retry=retry))
        self._begin(info)
        cell.cameras_running = True
        if self._controller is not None:  # the policy's runner looks first
            outcome = self._drive(info, self._controller)
        else:
            cell.wait(wait_s(LOOK_S, cell.rate_hz))
            outcome = self._plan(info, treatment, seed)
        text = f"{outcome.result}: {outcome.detail}"
        cell.streams.event("label", cell.now_ns, text=text, outcome=asdict(outcome))
        cell.cameras_running = False
        self._end(outcome)
        return outcome

    def _drive(self, info: EpisodeInfo, controller: Controller) -> Outcome:
        """Let a policy act, and label; a limit that stops it is a failure."""
        cell = self._cell
        stopped, problem = controller.drive(info.id, self._config.max_s)
        if stopped == STOPPED_BY_OPERATOR:
            self._open = False
            raise StoppedError
        cell.wait(wait_s(SETTLE_S, cell.rate_hz))
        if problem:
            return void_trial(cell.task, problem)
        stopped = stopped or cell.stopped
        return label_trial(cell.world.task, cell.truth, executed=True, stopped=stopped)

    def _plan(self, info: EpisodeInfo, treatment: Treatment, seed: int) -> Outcome:
        """Plan, execute and label."""
        cell = self._cell
        decision = self._decider.still_allowed(self._decider.decide(info, seed))
        if decision.plan is not None:
            execute_plan(cell, decision.plan)
        else:
            cell.wait(wait_s(LOOK_S, cell.rate_hz))
        if decision.void and not treatment.study_arm:
            return void_trial(cell.task, decision.remark)
        executed, remark, stopped = decision.plan is not None, decision.remark, cell.stopped
        task, truth = cell.world.task, cell.truth
        return label_trial(task, truth, executed=executed, remark=remark, stopped=stopped)

    def _info(self, episode_id: str, *, kind: str, **fields: Any) -> EpisodeInfo:
        task = self._cell.task
        return EpisodeInfo(
            id=episode_id,
            kind=kind,
            task=task.name,
            instruction=task.instruction,
            operator=OPERATOR,
            robot=ROBOT_NAME,
            cell=self._config.cell,
            stand_in=True,
            **fields,
        )

    def _begin(self, info: EpisodeInfo) -> None:
        record = {key: value for key, value in asdict(info).items() if value is not None}
        record["tags"] = list(info.tags)
        del record["id"]
        # A simulated cell publishes nothing before its episode begins: nothing can be missing yet.
        request = {"id": info.id, "info": record, "anyway": True, **self._sent}
        answer = self._control("start", request)
        if remark := answer.get("task_remark"):
            self._output.detail(str(remark))
        self._open = True
        self._cell.announce()

    def _end(self, outcome: Outcome | None, *, discard: bool = False) -> None:
        record = None if outcome is None else asdict(outcome)
        answer = self._control("stop", {"outcome": record, "discard": discard})
        self._open = False
        self._output.detail(f"recorded {json.dumps(answer)}")
        self._cell.skip(BETWEEN_S)

    def abandon(self, *, discard: bool) -> None:
        """Close an episode that was interrupted, if one is open, or throw it away."""
        self._cell.cameras_running = False
        if self._open:
            self._end(void_trial(self._cell.task, INTERRUPTED), discard=discard)

    def _control(self, verb: str, request: Mapping[str, Any]) -> dict[str, Any]:
        key = f"rec/{self._config.recorder}/ctl/{verb}"
        payload = json.dumps(request).encode()
        answer = self._session.query(key, payload, timeout_s=CONTROL_TIMEOUT_S)
        return dict(json.loads(answer))
