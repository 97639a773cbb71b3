"""One replay of one trajectory: what decides it, doing it, comparing it, and its row in the table.

An executed replay is laid over the planned one and the recording before it is written.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.metadata import SAME_ENGINE_KEY, SECOND_ENGINE_KEY, Derived
from bridge.episode.provenance import hash_settings
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import GRIPPER_STATE, JOINT_STATES, ROBOT_DESCRIPTION
from bridge.errors import EpisodeError, GstError
from bridge.robots.robot import read_robot, robot_of
from bridge.task.plan import Plan
from bridge.task.predicate import evaluate_success
from bridge.task.record import parse_record
from bridge.task.task_file import Task
from bridge.task.verdict import SAME_ENGINE, Verdict, is_same_engine
from twin.physics.config import Engine
from twin.replay.agreement import disagreement_of, in_each_engine
from twin.replay.config import ReplayConfig
from twin.replay.divergence import Divergence, diverge
from twin.replay.execution import (
    check_covers,
    check_length,
    cut_track,
    path_of_execution,
    stages_as_executed,
)
from twin.replay.failure import NOT_EVALUATED
from twin.replay.monte_carlo import replay_samples, with_probability
from twin.replay.output import ReplayOrigin, write_replay
from twin.replay.rebuilt_scene import Correction, RebuiltScene, read_rebuilt_scene
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene, StartState
from twin.replay.trace import (
    CONTACT_M,
    Recording,
    Trace,
    rollout_of_recording,
    states_of_recording,
    trace_of_file,
    trace_of_recording,
    trace_of_result,
)
from twin.replay.verdict import KINEMATIC_ENGINE, engine_of, findings_of, replay_joints, replay_plan
from twin.robot.collision import hulls_of
from twin.robot.model import load_robot
from twin.robot.posture import check_clock, width_track

REPLAY_VERSION = 23
"""Raise it when the same inputs give another replay, so that old files are redone."""

START_KNOWN_NS = 1_000_000_000
"""Joint states this near to a plan's start say where the arm was."""

MAY_STAY_OPEN = ("settled", "shape")
"""Predicates that a recording without an answer to them may succeed without."""


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
    task: Task
    start: StartState
    scene_hash: str | None
    config: ReplayConfig
    folder: Path
    duration_s: float = 0.0
    """Of the plan; what takes longer is begun first."""
    end: StartState = field(default_factory=StartState)
    """Where the objects were localised after the execution."""
    run_path: Path | None = None
    """Whose scene folder is used; None: the task's shapes and the table plane."""
    shapes: Mapping[str, str] = field(default_factory=dict)
    """Hashes of the scene's files that a replay reads."""
    calibration_id: str | None = None
    render: bool = False
    """Also draw what the recorded cameras would have seen."""
    robot: str = ""
    """Robot file whose description is used; "": the recorded one."""
    problem: str = ""
    """Why the plan's execution, of which there was one, cannot be replayed."""

    @property
    def was_executed(self) -> bool:
        """Whether the recording says so, also of one that cannot be replayed."""
        return self.end_ns is not None or bool(self.problem)

    @property
    def needs_planned(self) -> bool:
        """Whether it is compared with the planned replay, which must then be there before."""
        return self.trajectory == "executed" and self.config.mode == "dynamic"

    def planned(self) -> "ReplayJob":
        """The planned replay of the same plan from the same start."""
        return replace(self, trajectory="planned")

    def cost(self) -> float:
        """How long it takes, compared with others."""
        if self.config.mode == "kinematic":
            return 0.1 * self.duration_s
        bodies = 1 + len(self.task.soft_objects)
        return (1 + self.config.samples) * bodies * self.duration_s

    def needed_paths(self) -> tuple[Path, ...]:
        """What a process on another machine must see."""
        scene = () if self.run_path is None else (self.run_path,)
        robot = (Path(self.robot).resolve(),) if self.robot.endswith(".toml") else ()
        return (self.episode_path, self.folder, *scene, *robot)

    def engines(self) -> tuple[Engine, ...]:
        """What replays it, the engine that decides first; a kinematic replay moves no bodies."""
        return self.config.engines()[: None if self.config.mode == "dynamic" else 1]

    def path(self, engine: Engine | None = None) -> Path:
        """Where the derived episode goes, of an engine or of the one that decides."""
        plan = re.sub(r"[^A-Za-z0-9_-]", "-", self.plan_id)[:60] or "plan"
        name: str = self.engines()[0] if engine is None else engine
        if self.config.mode == "kinematic":
            name = KINEMATIC_ENGINE
        elif self.config.grasp == "attach":
            name += "-attach"
        parts = (
            self.episode_path.stem,
            "replay",
            self.trajectory,
            self.config.mode,
            plan,
            name,
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
            "engine": " and ".join(self._engine_names()),
            "episode_sha256": self.episode_sha256,
            "plan_index": self.plan_index,
            "start_ns": self.start_ns,
            "scene_hash": self.scene_hash,
            "task": asdict(self.task),
            "Ts_base_object": {name: T.tolist() for name, T in self.start.Ts_base_object.items()},
            "config": asdict(self.config),
            "shapes": dict(self.shapes),
            "calibration_id": self.calibration_id,
            "render": self.render,
            **self._named_robot(),
            **self._sampled_from(),
            **self._compared_with(),
        }

    def _engine_names(self) -> list[str]:
        config = replace(self.config, engines_must_agree=False)
        return [engine_of(self.task, replace(config, engine=each)) for each in self.engines()]

    def _named_robot(self) -> dict[str, Any]:
        if not self.robot:
            return {}
        return {"robot": hash_settings({"urdf": read_robot(self.robot).description()})}

    def _sampled_from(self) -> dict[str, Any]:
        if not self.config.samples:
            return {}
        spreads = self.start.covariances
        return {"covariances": {name: spreads[name].tolist() for name in sorted(spreads)}}

    def _compared_with(self) -> dict[str, Any]:
        if self.trajectory != "executed":
            return {}
        return {"end": {name: T.tolist() for name, T in self.end.Ts_base_object.items()}}


def row_of_existing(job: ReplayJob) -> dict[str, Any] | None:
    """Return the row of a replay that is there already, None when it must be made."""
    found = []
    try:
        for engine in job.engines():
            if not job.path(engine).is_file():
                return None
            episode = Episode.open(job.path(engine))
            found.append((streams.verdicts(episode)[-1][1], divergence_of(episode)))
    except (GstError, IndexError):
        return None
    return judged(job, *found[0], skipped=True)


def divergence_of(episode: Episode) -> dict[str, Any] | None:
    """The gst divergence record of a replay; None where it was compared with nothing."""
    records = [
        parse_record(message.data, name="divergence")
        for message in episode.messages(episode.topics_of_type(schema.DIVERGENCE))
    ]
    return records[-1] if records else None


def row_of_failure(job: ReplayJob, message: str) -> dict[str, Any]:
    """Return the row of a trajectory that was not evaluated, with the reason.

    Args:
        job: The replay that was asked for.
        message: Why it was not made.
    """
    why = message.removeprefix(NOT_EVALUATED)
    return {**_row(job), "error": f"{NOT_EVALUATED}{why}", "reason": f"{NOT_EVALUATED}{why}"}


def _row(job: ReplayJob) -> dict[str, Any]:
    return {
        "episode": job.episode_path.stem,
        "plan": job.plan_id,
        "task": job.task.name,
        "trajectory": job.trajectory,
        "mode": job.config.mode,
        "executed": job.was_executed,
        "file": job.path().name,
        "skipped": False,
        "accepted": None,
        "first_failing": None,
        "reason": None,
        "error": None,
        "engine": None,
        "engines": list(job.engines()) if job.config.mode == "dynamic" else [],
        "engines_disagree": None,
        "warnings": [],
        "predicates": None,
        "divergence": None,
    }


def judged(
    job: ReplayJob,
    verdict: Verdict,
    divergence: Mapping[str, Any] | None = None,
    *,
    skipped: bool = False,
) -> dict[str, Any]:
    """Return the row of a trajectory with its verdict, and where it diverges from the others.

    Args:
        job: The replay that was asked for.
        verdict: What came out.
        divergence: Where planned, executed and recorded part; None: they were not compared.
        skipped: The verdict was there from an earlier run.
    """
    return {
        **_row(job),
        "skipped": skipped,
        "accepted": verdict.accepted,
        "first_failing": verdict.first_failing,
        "reason": verdict.reason,
        "engine": verdict.engine,
        "engines_disagree": disagreement_of(verdict),
        "warnings": list(verdict.warnings),
        "predicates": predicates_hold(verdict),
        "p_success": verdict.p_success,
        "divergence": None if divergence is None else dict(divergence),
    }


def predicates_hold(verdict: Verdict) -> bool | None:
    """Whether the success predicates hold; None when what is known does not say.

    One look afterwards seldom tells whether a thing lies still or kept its shape: those may stay
    open. A thing that nobody found was not seen to be where it belongs.
    """
    values = [
        item["value"]
        for item in verdict.findings
        if item["value"] is not None or item["kind"] not in MAY_STAY_OPEN
    ]
    if False in values:
        return False
    return None if None in values or not values else True


Findings = dict[tuple[str, str], bool | None]


def recorded_findings(recording: Recording, config: ReplayConfig) -> tuple[dict[str, Any], ...]:
    """What the success predicates, and the one on contacts, say of the recording itself.

    Args:
        recording: What was measured during one execution.
        config: Limits that contacts are inferred with.
    """
    robot = load_robot(recording.scene.urdf)
    rollout = rollout_of_recording(recording, robot, hulls_of(robot), config)
    task = recording.scene.task
    return tuple(findings_of(task, rollout, "recorded", tolerance_m=CONTACT_M))


def compare(
    job: ReplayJob, engine: Engine, result: ReplayResult, recording: Recording, end_ns: int
) -> Divergence:
    """Lay the executed replay, the planned one if it is there, and the recording over each other.

    Args:
        job: The executed replay's; names the planned replay's file.
        engine: What both were replayed in.
        result: The executed replay.
        recording: What was measured.
        end_ns: When the execution ended, from its start.
    """
    robot = load_robot(recording.scene.urdf)
    executed = trace_of_result(result, "executed", end_ns)
    recorded = trace_of_recording(recording, robot, job.config.sample_rate_hz)
    traces = [executed, recorded]
    task = job.task
    findings = {
        "executed": _findings(findings_of(task, result.rollout(), "replayed")),
        "recorded": {
            (finding.kind, finding.object_id): finding.value
            for finding in evaluate_success(task, states_of_recording(recording, robot))
        },
    }
    planned, planned_findings = _planned(job, engine, recording)
    if isinstance(planned, str):
        missing = [planned]
    else:
        traces.append(planned)
        findings["planned"] = planned_findings
        missing = []
    missing += [
        f"{name} was not localised after the execution: {reason}"
        for name, reason in recording.end.reasons.items()
        if name in recording.scene.movable()
    ]
    return diverge(
        job.plan_id, traces, job.config.divergence, findings=findings, not_compared=missing
    )


def _planned(job: ReplayJob, engine: Engine, recording: Recording) -> tuple[Trace | str, Findings]:
    path = job.planned().path(engine)
    if not path.is_file():
        return "the plan was not replayed: nothing planned to compare with", {}
    try:
        trace = trace_of_file(path, "planned", job.start_ns, recording.plan.tau[-1].t_ns)
        verdict = streams.verdicts(Episode.open(path))[-1][1]
    except (GstError, IndexError, StopIteration) as error:
        return f"{path.name} cannot be read: {error}", {}
    return trace, _findings([f for f in verdict.findings if f["side"] == "replayed"])


def _findings(found: list[dict[str, Any]]) -> Findings:
    return {(item["kind"], str(item.get("object", ""))): item["value"] for item in found}


def run_job(job: ReplayJob) -> dict[str, Any]:
    """Replay and write; a failure the user can act on becomes a row, not an exception."""
    if job.problem and job.trajectory == "executed":
        return row_of_failure(job, job.problem)
    try:
        return judged(job, *_replay(job)[0])
    except GstError as error:
        return row_of_failure(job, str(error))


@dataclass(frozen=True, kw_only=True)
class _Source:
    """What one job works on."""

    job: ReplayJob
    episode: Episode
    plan: Plan
    """As it was sent."""
    plan_as_executed: Plan
    """With the stages at the times at which they were executed."""
    events: list[dict[str, Any]]
    scene: ReplayScene
    correction: Correction
    """Applied to the scene already, still to be to what was localised afterwards, and to be taken
    back for pictures."""

    @property
    def executed(self) -> bool:
        return self.job.trajectory == "executed" and self.job.end_ns is not None

    def is_same_engine(self, result: ReplayResult) -> bool:
        """Whether the verdict is that of the engine that moved the cell itself."""
        engine, stand_in = result.verdict.engine, self.episode.info.stand_in
        return self.job.config.mode == "dynamic" and is_same_engine(engine, stand_in=stand_in)

    @property
    def end_ns(self) -> int:
        """When the trajectory ended and settling began."""
        return self.job.length_ns() if self.executed else self.plan.tau[-1].t_ns


def _replay(job: ReplayJob) -> list[tuple[Verdict, dict[str, Any] | None]]:
    """Replay in each engine and write an episode for each: verdicts, and where they diverge."""
    source = _open(job)

    results: list[ReplayResult] = []

    def judge(config: ReplayConfig) -> Verdict:
        results.append(_with_samples(source, config, _run(source, source.scene, config)))
        return results[-1].verdict

    verdicts = in_each_engine(source.scene.task, job.config, judge)
    return [
        _write(source, engine, replace(result, verdict=verdict))
        for engine, result, verdict in zip(job.engines(), results, verdicts, strict=True)
    ]


def _write(
    source: _Source, engine: Engine, result: ReplayResult
) -> tuple[Verdict, dict[str, Any] | None]:
    job, divergence = source.job, None
    if source.executed and job.config.mode == "kinematic":
        found = recorded_findings(_recording(source), job.config)
        result = replace(result, verdict=replace(result.verdict, findings=found))
    elif source.executed:
        compared = compare(job, engine, result, _recording(source), source.end_ns)
        divergence = compared.to_record()
    if source.is_same_engine(result):
        result = replace(result, verdict=_marked(result.verdict))
    images = _images(source, result) if job.render else ()
    path = job.path(engine)
    path.unlink(missing_ok=True)
    write_replay(path, result, source.plan, _origin(source, engine, result, divergence, images))
    return result.verdict, divergence


def _marked(verdict: Verdict) -> Verdict:
    """Say that the cell was moved by the same engine."""
    return replace(
        verdict,
        warnings=(*verdict.warnings, SAME_ENGINE),
        reason=verdict.reason or SAME_ENGINE,
    )


def _open(job: ReplayJob) -> _Source:
    episode = Episode.open(job.episode_path)
    urdf = streams.robot_description(episode)
    if job.robot:
        urdf = read_robot(job.robot).description()
    if urdf is None:
        raise EpisodeError(
            path=job.episode_path,
            found="no robot description",
            hint=f"Record {ROBOT_DESCRIPTION}, or attach the URDF as robot.urdf.",
        )
    plan = streams.plans(episode)[job.plan_index][1]
    task = job.task
    rebuilt = (
        RebuiltScene()
        if job.run_path is None
        else read_rebuilt_scene(RunFolder(job.run_path), task)
    )
    scene = replace(rebuilt, scene_hash=job.scene_hash).scene(
        task,
        urdf,
        job.start.Ts_base_object,
        reasons=job.start.reasons,
        covariances=job.start.covariances,
    )
    executed = job.trajectory == "executed" and job.end_ns is not None
    if job.trajectory == "planned":
        joints = robot_of(urdf).joints
        scene = replace(scene, start_rad=recorded_start(episode, job.start_ns, joints))
    events = streams.events(episode) if executed else []
    plan_as_executed = replace(plan, stages=stages_as_executed(plan, events, job.start_ns))
    return _Source(
        job=job,
        episode=episode,
        plan=plan,
        plan_as_executed=plan_as_executed,
        events=events,
        scene=scene,
        correction=rebuilt.correction,
    )


def recorded_start(
    episode: Episode, stamp_ns: int, joints: Sequence[str]
) -> Float[np.ndarray, " num_joints"] | None:
    """Where the arm was recorded to be when a plan began [rad]; None where nobody recorded it."""
    try:
        track = streams.joint_track(episode, JOINT_STATES)
    except GstError:
        return None
    near = np.abs(track.stamps_ns - stamp_ns) <= START_KNOWN_NS
    if not near.any() or not set(joints) <= set(track.names):
        return None
    order = [track.names.index(name) for name in joints]
    found: Float[np.ndarray, " num_joints"] = track.at(np.array([stamp_ns]))[0, order]
    return found if np.isfinite(found).all() else None


def _run(source: _Source, scene: ReplayScene, config: ReplayConfig) -> ReplayResult:
    if not source.executed:
        return replay_plan(source.plan_as_executed, scene, config)
    arm, widths = _tracks(source)
    return replay_joints(arm, widths, scene, config, plan=source.plan_as_executed)


def _tracks(source: _Source) -> tuple[streams.JointTrack, streams.JointTrack]:
    """Recorded joints and widths, cut to the execution."""
    job, episode = source.job, source.episode
    end_ns = job.start_ns + job.length_ns()
    check_clock(episode, (JOINT_STATES, GRIPPER_STATE), job.start_ns, end_ns, source.plan.id)
    check_length(job.length_ns(), source.plan)
    arm = cut_track(streams.joint_track(episode, JOINT_STATES), job.start_ns, end_ns)
    check_covers(arm, "joints", end_ns, source.plan)
    widths = cut_track(width_track(episode, robot_of(source.scene.urdf)), job.start_ns, end_ns)
    check_covers(widths, "gripper widths", end_ns, source.plan)
    return arm, widths


def _recording(source: _Source) -> Recording:
    job = source.job
    arm, widths = _tracks(source)
    kinematic = replace(job.config, mode="kinematic")
    seen_ns = job.end.seen_ns
    return Recording(
        plan=source.plan_as_executed,
        path=path_of_execution(
            arm, widths, source.plan_as_executed, kinematic, robot_of(source.scene.urdf)
        ),
        scene=source.scene,
        end=source.correction.state(job.end),
        end_seen_ns=job.length_ns() if seen_ns is None else seen_ns - job.start_ns,
    )


def _with_samples(source: _Source, config: ReplayConfig, result: ReplayResult) -> ReplayResult:
    """Ask varied replays too; plans of one episode are tried against the same variations."""
    if not config.samples or source.scene.missing():
        return result
    samples = replay_samples(
        lambda there, varied: _run(source, there, varied).verdict,
        source.scene,
        config,
        plan_id=source.plan.id,
        identity=source.job.episode_sha256,
    )
    return replace(result, verdict=with_probability(result.verdict, samples), samples=samples)


def _images(source: _Source, result: ReplayResult) -> tuple[tuple[str, CompressedColor], ...]:
    from twin.replay.images import render_replay  # noqa: PLC0415  # only where it is asked for

    if source.job.run_path is None:
        return ()
    return tuple(
        render_replay(
            RunFolder(source.job.run_path),
            source.episode,
            result,
            source.scene,
            start_ns=source.job.start_ns,
            executed=source.job.end_ns is not None,
            planned=source.job.trajectory == "planned",
            correction=source.correction,
        )
    )


def _origin(
    source: _Source,
    engine: Engine,
    result: ReplayResult,
    divergence: dict[str, Any] | None,
    images: tuple[tuple[str, CompressedColor], ...],
) -> ReplayOrigin:
    job, episode, plan = source.job, source.episode, source.plan
    marks = {
        SAME_ENGINE_KEY: source.is_same_engine(result),
        SECOND_ENGINE_KEY: engine != job.engines()[0],
    }
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
        calibration_id=source.scene.calibration_id,
        settings={
            **job.settings(),
            "shape_sources": dict(source.scene.shape_sources),
            **{name: True for name, holds in marks.items() if holds},
        },
    )
    return ReplayOrigin(
        info=episode.info,
        derived=derived,
        cell=cell_of(episode),
        start_ns=job.start_ns,
        urdf=source.scene.urdf,
        stages=source.plan_as_executed.stages,
        gripper=_recorded_grips(plan, source.events, job.start_ns)
        if source.executed
        else planned_grips(plan),
        end_ns=source.end_ns,
        divergence=divergence,
        images=images,
    )


def planned_grips(plan: Plan) -> tuple[tuple[int, str], ...]:
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
