"""Do one replay: open its episode, replay in each engine, compare, write, report a row."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.executions import executed_events
from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import GRIPPER_STATE, JOINT_STATES, ROBOT_DESCRIPTION
from bridge.errors import EpisodeError, GstError
from bridge.robots.robot import Robot, read_robot, robot_of
from bridge.task.plan import Plan
from bridge.task.verdict import SAME_ENGINE, Verdict, is_same_engine
from twin.replay.divergence import diverge
from twin.replay.execution import (
    check_covers,
    check_length,
    cut_track,
    in_order,
    path_of_execution,
    stages_as_executed,
)
from twin.replay.job import WITHOUT, ReplayJob, judged, row_of_failure
from twin.replay.monte_carlo import with_samples
from twin.replay.observed import observed_plan
from twin.replay.output import ReplayOrigin, write_replay
from twin.replay.rebuilt_scene import read_rebuilt_scene
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.replay.trace import (
    Recording,
    Trace,
    states_of_recording,
    trace_of_file,
    trace_of_recording,
    trace_of_result,
)
from twin.replay.verdict import command_of, findings_of, replay_joints, replay_plan
from twin.robot.model import load_robot
from twin.robot.posture import check_clock, width_track

Tracks = tuple[streams.JointTrack, streams.JointTrack]
START_KNOWN_NS = 1_000_000_000
"""Joint states this near to a plan's start say where the arm was."""


def run_job(job: ReplayJob) -> dict[str, Any]:
    """Replay and write; a failure the user can act on becomes a row, not an exception."""
    if job.problem and job.trajectory == "executed":
        return row_of_failure(job, job.problem)
    try:
        return judged(job, *_replay(job))
    except GstError as error:
        return row_of_failure(job, str(error))


@dataclass(frozen=True, kw_only=True)
class _Source:
    """What one job works on."""

    job: ReplayJob
    episode: Episode
    plan: Plan
    """As it was sent; without one, what was observed, in a plan's words."""
    plan_as_executed: Plan
    """With the stages at the times at which they were executed."""
    scene: ReplayScene
    tracks: Tracks | None
    """Recorded joints and widths of what was executed; None: the plan is replayed."""

    @property
    def end_ns(self) -> int:
        """When the trajectory ended and settling began."""
        return self.plan.tau[-1].t_ns if self.tracks is None else self.job.length_ns()


def _replay(job: ReplayJob) -> tuple[Verdict, dict[str, Any] | None]:
    """Replay and write an episode: the verdict, and where it diverges from the others."""
    source, divergence = _open(job), None
    job.config.refuse_soft(source.scene.task.soft_objects)
    scene, plan = source.scene, source.plan_as_executed
    if source.tracks is None:
        result = _with_samples(source, replay_plan(plan, scene, job.config))
    else:
        result = replay_joints(*source.tracks, scene, job.config, plan=plan)
    if source.tracks is not None:
        recording = _recording(source, *source.tracks)
        if job.config.mode == "kinematic":
            found = recorded_findings(recording)
            result = replace(result, verdict=replace(result.verdict, findings=found))
        else:
            divergence = compare(job, result, recording, source.end_ns)
    engine, stand_in = result.verdict.engine, source.episode.info.stand_in
    if job.config.mode == "dynamic" and is_same_engine(engine, stand_in=stand_in):
        told, why = (*result.verdict.warnings, SAME_ENGINE), result.verdict.reason or SAME_ENGINE
        result = replace(result, verdict=replace(result.verdict, warnings=told, reason=why))
    images = _images(source, result) if job.render else ()
    path = job.path()
    path.unlink(missing_ok=True)
    write_replay(path, result, source.plan, _origin(source, result, divergence, images))
    return result.verdict, divergence


def _open(job: ReplayJob) -> _Source:
    episode = Episode.open(job.episode_path)
    named = read_robot(job.robot).description() if job.robot else None
    urdf = named or streams.robot_description(episode)
    if urdf is None:
        raise EpisodeError(
            path=job.episode_path,
            found="no robot description",
            hint=f"Record {ROBOT_DESCRIPTION}, or attach the URDF as robot.urdf.",
        )
    task, robot = job.task, load_robot(urdf)
    executed = job.trajectory == "executed" and job.end_ns is not None
    tracks = _tracks(job, episode, robot.record) if executed else None
    if job.plan_index == WITHOUT and tracks is not None:
        arm, widths = in_order(tracks[0], robot.record, job.plan_id), tracks[1]
        plan = observed_plan(arm, widths, robot, task, episode.info)
    else:
        plan = streams.plans(episode)[job.plan_index][1]
    known = ReplayScene(task=task)
    if job.run_path is not None:
        known = read_rebuilt_scene(RunFolder(job.run_path), task)
    scene = replace(
        known,
        urdf=urdf,
        scene_hash=job.scene_hash,
        Ts_base_object=job.start.Ts_base_object,
        reasons=job.start.reasons,
        covariances=job.start.covariances,
    )
    if job.trajectory == "planned":
        scene = replace(scene, start_rad=recorded_start(episode, job.start_ns, robot.joints))
    events = executed_events(episode) if executed else []
    return _Source(
        job=job,
        episode=episode,
        plan=plan,
        plan_as_executed=replace(plan, stages=stages_as_executed(plan, events, job.start_ns)),
        scene=scene,
        tracks=tracks,
    )


def recorded_start(
    episode: Episode, stamp_ns: int, joints: Sequence[str]
) -> Float[np.ndarray, " num_joints"] | None:
    """Where the arm was recorded to be when a plan began [rad]; None where no numbers say it."""
    found = recorded_joints(episode, stamp_ns, joints)
    return found if found is not None and np.isfinite(found).all() else None


def recorded_joints(
    episode: Episode, stamp_ns: int, joints: Sequence[str]
) -> Float[np.ndarray, " num_joints"] | None:
    """Joints as recorded near an instant [rad], numbers or not; None where there are none."""
    try:
        track = streams.joint_track(episode, JOINT_STATES)
    except GstError:
        return None
    near = np.abs(track.stamps_ns - stamp_ns) <= START_KNOWN_NS
    if not near.any() or not set(joints) <= set(track.names):
        return None
    order = [track.names.index(name) for name in joints]
    return np.asarray(track.at(np.array([stamp_ns]))[0, order])


def _tracks(job: ReplayJob, episode: Episode, robot: Robot) -> Tracks:
    """Recorded joints and widths, cut to the execution."""
    plan_id, end_ns = job.plan_id, job.start_ns + job.length_ns()
    check_clock(episode, (JOINT_STATES, GRIPPER_STATE), job.start_ns, end_ns, plan_id)
    check_length(job.length_ns(), plan_id)
    arm = cut_track(streams.joint_track(episode, JOINT_STATES), job.start_ns, end_ns)
    check_covers(arm, "joints", end_ns, plan_id)
    widths = cut_track(width_track(episode, robot), job.start_ns, end_ns)
    check_covers(widths, "gripper widths", end_ns, plan_id)
    return arm, widths


def _recording(source: _Source, arm: streams.JointTrack, widths: streams.JointTrack) -> Recording:
    job, seen_ns = source.job, source.job.end.seen_ns
    kinematic = replace(job.config, mode="kinematic")
    return Recording(
        plan=source.plan_as_executed,
        path=path_of_execution(
            arm, widths, source.plan_as_executed, kinematic, robot_of(source.scene.urdf)
        ),
        scene=source.scene,
        end=job.end,
        end_seen_ns=job.length_ns() if seen_ns is None else seen_ns - job.start_ns,
    )


def _with_samples(source: _Source, result: ReplayResult) -> ReplayResult:
    """Ask varied replays too; plans of one episode are tried against the same variations."""
    scene, config, plan = source.scene, source.job.config, source.plan_as_executed
    if scene.missing() or not config.samples:
        return result
    commanded = command_of(plan, scene, config)
    verdict = with_samples(
        result.verdict,
        lambda *drawn: replay_plan(plan, *drawn, commanded=commanded, known=result).verdict,
        scene,
        config,
        identity=source.job.episode_sha256,
    )
    return replace(result, verdict=verdict)


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
        )
    )


def _origin(
    source: _Source,
    result: ReplayResult,
    divergence: dict[str, Any] | None,
    images: tuple[tuple[str, CompressedColor], ...],
) -> ReplayOrigin:
    job, episode, plan = source.job, source.episode, source.plan
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
        settings=job.settings(),
    )
    return ReplayOrigin(
        info=episode.info,
        derived=derived,
        cell=cell_of(episode),
        start_ns=job.start_ns,
        urdf=source.scene.urdf,
        stages=source.plan_as_executed.stages,
        end_ns=source.end_ns,
        divergence=divergence,
        images=images,
    )


Findings = dict[tuple[str, str], bool | None]


def recorded_findings(recording: Recording) -> tuple[dict[str, Any], ...]:
    """What the success predicates say of the recording itself."""
    states = states_of_recording(recording, load_robot(recording.scene.urdf))
    return tuple(findings_of(recording.scene.task, states, "recorded"))


def compare(
    job: ReplayJob, result: ReplayResult, recording: Recording, end_ns: int
) -> dict[str, Any]:
    """Lay the executed replay over the planned one, if it is there, and over the recording."""
    robot = load_robot(recording.scene.urdf)
    executed = trace_of_result(result, "executed", end_ns)
    traces = [executed, trace_of_recording(recording, robot, job.config.states_hz)]
    findings = {
        "executed": _findings(findings_of(job.task, result, "replayed")),
        "recorded": _findings(recorded_findings(recording)),
    }
    planned = _planned(job, recording)
    if planned is not None:
        trace, findings["planned"] = planned
        traces.append(trace)
    return diverge(job.plan_id, traces, findings=findings)


def _planned(job: ReplayJob, recording: Recording) -> tuple[Trace, Findings] | None:
    """The planned replay, if there is one that can be read."""
    try:
        path = job.planned().path()
        trace = trace_of_file(path, "planned", job.start_ns, recording.plan.tau[-1].t_ns)
        verdict = streams.verdicts(Episode.open(path))[-1][1]
    except (GstError, IndexError, StopIteration):
        return None
    return trace, _findings(f for f in verdict.findings if f["side"] == "replayed")


def _findings(found: Iterable[dict[str, Any]]) -> Findings:
    return {(item["kind"], str(item.get("object", ""))): item["value"] for item in found}


def cell_of(episode: Episode) -> str:
    """The first part of the plan's topic: the cell everything was recorded in."""
    for topic in episode.topics_of_type(schema.PLAN):
        return topic.split("/")[1]
    return episode.info.cell or "cell"
