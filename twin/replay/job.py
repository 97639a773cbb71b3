"""One replay of one trajectory, as a process of the pool runs it."""

import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bridge.episode import schema, streams
from bridge.episode.metadata import Derived
from bridge.episode.provenance import hash_settings
from bridge.episode.reader import Episode
from bridge.errors import EpisodeError, GstError
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from bridge.task.verdict import Verdict
from twin.physics.engine import ENGINE, ENGINE_VERSION
from twin.replay.config import ReplayConfig
from twin.replay.execution import check_covers, cut_track, stages_as_executed
from twin.replay.files import ReplayOrigin, write_replay
from twin.replay.result import ReplayResult
from twin.replay.rollout import KINEMATIC_ENGINE, replay_joints, replay_plan
from twin.replay.samples import replay_samples, with_probability
from twin.replay.scene import ReplayScene
from twin.replay.starts import StartState

REPLAY_VERSION = 2
"""Raise it when the same inputs give another replay, so that old files are redone."""


@dataclass(frozen=True, kw_only=True)
class ReplayJob:
    """Everything that decides one replay; its content names the file."""

    episode_path: Path
    episode_sha256: str
    plan_id: str
    plan_index: int
    """Position among the plans of the episode, because ids may repeat."""
    trajectory: str
    start_ns: int
    end_ns: int | None
    """Of the recorded execution, None for a plan that was never executed."""
    task: str
    start: StartState
    scene_hash: str | None
    config: ReplayConfig
    folder: Path
    duration_s: float = 0.0
    """Of the plan; what takes longer is begun first."""

    def cost(self) -> float:
        """How long it takes, compared with others."""
        if self.config.mode == "kinematic":
            return 0.1 * self.duration_s
        bodies = 1 + len(load_task(self.task).soft_objects)
        return (1 + self.config.samples) * bodies * self.duration_s

    def needed_paths(self) -> tuple[Path, ...]:
        """What a process on another machine must see."""
        return (self.episode_path, self.folder)

    def path(self) -> Path:
        """Where the derived episode goes."""
        plan = re.sub(r"[^A-Za-z0-9_-]", "-", self.plan_id)[:60] or "plan"
        engine = ENGINE if self.config.mode == "dynamic" else KINEMATIC_ENGINE
        parts = (
            self.episode_path.stem,
            "replay",
            self.trajectory,
            self.config.mode,
            plan,
            engine,
            hash_settings(self.settings()),
            "mcap",
        )
        return self.folder / ".".join(parts)

    def length_ns(self) -> int:
        """How long the recorded execution took; 0 for a plan that was never executed."""
        return 0 if self.end_ns is None else self.end_ns - self.start_ns

    def settings(self) -> dict[str, Any]:
        """What the settings hash covers: settings, inputs, engine and code version."""
        return {
            "replay_version": REPLAY_VERSION,
            "engine": ENGINE_VERSION if self.config.mode == "dynamic" else KINEMATIC_ENGINE,
            "episode_sha256": self.episode_sha256,
            "plan_index": self.plan_index,
            "start_ns": self.start_ns,
            "scene_hash": self.scene_hash,
            "task": asdict(load_task(self.task)),
            "Ts_base_object": {name: T.tolist() for name, T in self.start.Ts_base_object.items()},
            "config": asdict(self.config),
            **self._sampled_from(),
        }

    def _sampled_from(self) -> dict[str, Any]:
        if not self.config.samples:
            return {}
        spreads = self.start.covariances
        return {"covariances": {name: spreads[name].tolist() for name in sorted(spreads)}}


def run_job(job: ReplayJob) -> dict[str, Any]:
    """Replay and write; a failure the user can act on becomes a row, not an exception."""
    try:
        verdict = _replay(job)
    except GstError as error:
        return row_of_failure(job, str(error))
    return {**_row(job), **_judgement(verdict)}


def row_of_existing(job: ReplayJob) -> dict[str, Any] | None:
    """Return the row of a replay that is there already, None when it must be made."""
    if not job.path().is_file():
        return None
    try:
        verdicts = streams.verdicts(Episode.open(job.path()))
    except GstError:
        return None
    if not verdicts:
        return None
    return {**_row(job), **_judgement(verdicts[-1][1]), "skipped": True}


def row_of_failure(job: ReplayJob, message: str) -> dict[str, Any]:
    """Return the row of a replay that never came back."""
    return {**_row(job), "error": message}


def _row(job: ReplayJob) -> dict[str, Any]:
    return {
        "episode": job.episode_path.stem,
        "plan": job.plan_id,
        "trajectory": job.trajectory,
        "mode": job.config.mode,
        "executed": job.end_ns is not None,
        "file": job.path().name,
        "skipped": False,
        "accepted": None,
        "first_failing": None,
        "reason": None,
        "error": None,
    }


def _judgement(verdict: Verdict) -> dict[str, Any]:
    return {
        "accepted": verdict.accepted,
        "first_failing": verdict.first_failing,
        "reason": verdict.reason,
    }


def _replay(job: ReplayJob) -> Verdict:
    episode = Episode.open(job.episode_path)
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise EpisodeError(
            path=job.episode_path,
            found="no robot description",
            hint="Record /robot_description, or attach the URDF as robot.urdf.",
        )
    plan = streams.plans(episode)[job.plan_index][1]
    scene = ReplayScene(
        task=load_task(job.task),
        Ts_base_object=job.start.Ts_base_object,
        reasons=job.start.reasons,
        covariances=job.start.covariances,
        urdf=urdf,
        scene_hash=job.scene_hash,
    )
    executed = job.trajectory == "executed" and job.end_ns is not None
    events = streams.events(episode) if executed else []
    lived = replace(plan, stages=stages_as_executed(plan, events, job.start_ns))
    result = _with_samples(job, _run(job, episode, lived, scene), episode, lived, scene)
    derived = Derived(
        kind="replay",
        source_episode=episode.info.id,
        source_sha256=job.episode_sha256,
        plan_id=plan.id,
        trajectory=job.trajectory,
        mode=job.config.mode,
        scene_hash=job.scene_hash,
        engine=result.verdict.engine,
        seed=job.config.seed,
        settings=job.settings(),
    )
    origin = ReplayOrigin(
        info=episode.info,
        derived=derived,
        cell=cell_of(episode),
        start_ns=job.start_ns,
        urdf=urdf,
        stages=lived.stages,
        gripper=_recorded_grips(plan, events, job.start_ns) if executed else _planned_grips(plan),
        end_ns=job.length_ns() if executed else plan.tau[-1].t_ns,
    )
    path = job.path()
    path.unlink(missing_ok=True)
    write_replay(path, result, plan, origin)
    return result.verdict


def _run(job: ReplayJob, episode: Episode, plan: Plan, scene: ReplayScene) -> ReplayResult:
    if job.trajectory == "planned" or job.end_ns is None:
        return replay_plan(plan, scene, job.config)
    arm = cut_track(streams.joint_track(episode), job.start_ns, job.end_ns)
    check_covers(arm, job.end_ns, plan)
    widths = cut_track(streams.joint_track(episode, "/gripper/state"), job.start_ns, job.end_ns)
    return replay_joints(arm, widths, scene, job.config, plan=plan)


def _with_samples(
    job: ReplayJob, result: ReplayResult, episode: Episode, plan: Plan, scene: ReplayScene
) -> ReplayResult:
    """Ask varied replays too; plans of one episode are tried against the same variations."""
    if not job.config.samples or scene.missing():
        return result
    samples = replay_samples(
        lambda there, config: _run(replace(job, config=config), episode, plan, there).verdict,
        scene,
        job.config,
        plan_id=plan.id,
        identity=job.episode_sha256,
    )
    return replace(result, verdict=with_probability(result.verdict, samples), samples=samples)


def _planned_grips(plan: Plan) -> tuple[tuple[int, str], ...]:
    """When the plan changes its mind about the gripper; it starts open."""
    before = [0, *(waypoint.g for waypoint in plan.tau)]
    return tuple(
        (waypoint.t_ns, "close" if waypoint.g else "open")
        for waypoint, g in zip(plan.tau, before, strict=False)
        if waypoint.g != g
    )


def _recorded_grips(
    plan: Plan, events: list[dict[str, Any]], start_ns: int
) -> tuple[tuple[int, str], ...]:
    return tuple(
        (int(event["stamp_ns"]) - start_ns, str(event.get("text") or ""))
        for event in events
        if event["type"] == "gripper" and event.get("plan_id") == plan.id
    )


def cell_of(episode: Episode) -> str:
    """The first part of the plan's topic: the cell everything was recorded in."""
    for topic in episode.topics_of_type(schema.PLAN):
        return topic.split("/")[1]
    return episode.info.cell or "cell"
