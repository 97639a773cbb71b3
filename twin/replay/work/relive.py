"""Do one replay: read the episode, re-live the trajectory, compare it, write the file."""

from dataclasses import dataclass, replace
from typing import Any

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.metadata import Derived
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import EpisodeError, GstError
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from bridge.task.verdict import Verdict
from twin.replay.chance.samples import replay_samples, with_probability
from twin.replay.episode.file import ReplayOrigin, write_replay
from twin.replay.follow.execution import cut_track, path_of_execution, stages_as_executed
from twin.replay.follow.track_checks import check_covers, check_length
from twin.replay.parting.recorded import Recording
from twin.replay.place.calibrated import Correction
from twin.replay.place.rebuilt import Place, read_place
from twin.replay.place.scene import ReplayScene
from twin.replay.verdict.result import ReplayResult
from twin.replay.verdict.rollout import replay_joints, replay_plan
from twin.replay.work.compare import compare, recorded_findings
from twin.replay.work.job import ReplayJob, judged, row_of_failure
from twin.robot.clock import check_clock

JOINTS, GRIPPER_STATE = "/joint_states", "/gripper/state"


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
    """As it was sent."""
    lived: Plan
    """With the stages at the times at which they were lived through."""
    events: list[dict[str, Any]]
    scene: ReplayScene
    correction: Correction
    """Applied to the scene already, still to be to what was localised afterwards, and to be taken
    back for pictures."""

    @property
    def executed(self) -> bool:
        return self.job.trajectory == "executed" and self.job.end_ns is not None

    @property
    def end_ns(self) -> int:
        """When the trajectory ended and settling began."""
        return self.job.length_ns() if self.executed else self.plan.tau[-1].t_ns


def _replay(job: ReplayJob) -> tuple[Verdict, dict[str, Any] | None]:
    source = _open(job)
    result = _with_samples(source, _run(source, source.scene, job))
    divergence = None
    if source.executed and job.config.mode == "kinematic":
        found = recorded_findings(_recording(source), job.config)
        result = replace(result, verdict=replace(result.verdict, findings=found))
    elif source.executed:
        divergence = compare(job, result, _recording(source), source.end_ns).to_record()
    images = _images(source, result) if job.render else ()
    path = job.path()
    path.unlink(missing_ok=True)
    write_replay(path, result, source.plan, _origin(source, result, divergence, images))
    return result.verdict, divergence


def _open(job: ReplayJob) -> _Source:
    episode = Episode.open(job.episode_path)
    urdf = streams.robot_description(episode)
    if urdf is None:
        raise EpisodeError(
            path=job.episode_path,
            found="no robot description",
            hint="Record /robot_description, or attach the URDF as robot.urdf.",
        )
    plan = streams.plans(episode)[job.plan_index][1]
    task = load_task(job.task)
    place = Place() if job.run_path is None else read_place(RunFolder(job.run_path), task)
    scene = replace(place, scene_hash=job.scene_hash).scene(
        task,
        urdf,
        job.start.Ts_base_object,
        reasons=job.start.reasons,
        covariances=job.start.covariances,
    )
    executed = job.trajectory == "executed" and job.end_ns is not None
    events = streams.events(episode) if executed else []
    lived = replace(plan, stages=stages_as_executed(plan, events, job.start_ns))
    return _Source(
        job=job,
        episode=episode,
        plan=plan,
        lived=lived,
        events=events,
        scene=scene,
        correction=place.correction,
    )


def _run(source: _Source, scene: ReplayScene, job: ReplayJob) -> ReplayResult:
    if not source.executed:
        return replay_plan(source.lived, scene, job.config)
    arm, widths = _tracks(source)
    return replay_joints(arm, widths, scene, job.config, plan=source.lived)


def _tracks(source: _Source) -> tuple[streams.JointTrack, streams.JointTrack]:
    """Recorded joints and widths, cut to the execution."""
    job, episode = source.job, source.episode
    end_ns = job.start_ns + job.length_ns()
    check_clock(episode, (JOINTS, GRIPPER_STATE), job.start_ns, end_ns, source.plan.id)
    check_length(job.length_ns(), source.plan)
    arm = cut_track(streams.joint_track(episode, JOINTS), job.start_ns, end_ns)
    check_covers(arm, "joints", end_ns, source.plan)
    widths = cut_track(streams.joint_track(episode, GRIPPER_STATE), job.start_ns, end_ns)
    check_covers(widths, "gripper widths", end_ns, source.plan)
    return arm, widths


def _recording(source: _Source) -> Recording:
    job = source.job
    arm, widths = _tracks(source)
    kinematic = replace(job.config, mode="kinematic")
    seen_ns = job.end.seen_ns
    return Recording(
        plan=source.lived,
        path=path_of_execution(arm, widths, source.lived, kinematic),
        scene=source.scene,
        end=source.correction.state(job.end),
        end_seen_ns=job.length_ns() if seen_ns is None else seen_ns - job.start_ns,
    )


def _with_samples(source: _Source, result: ReplayResult) -> ReplayResult:
    """Ask varied replays too; plans of one episode are tried against the same variations."""
    job = source.job
    if not job.config.samples or source.scene.missing():
        return result
    samples = replay_samples(
        lambda there, config: _run(source, there, replace(job, config=config)).verdict,
        source.scene,
        job.config,
        plan_id=source.plan.id,
        identity=job.episode_sha256,
    )
    return replace(result, verdict=with_probability(result.verdict, samples), samples=samples)


def _images(source: _Source, result: ReplayResult) -> tuple[tuple[str, CompressedColor], ...]:
    from twin.replay.episode.images import render_replay  # noqa: PLC0415  # only where it is asked for

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
        settings={**job.settings(), "shape_sources": dict(source.scene.shape_sources)},
    )
    return ReplayOrigin(
        info=episode.info,
        derived=derived,
        cell=cell_of(episode),
        start_ns=job.start_ns,
        urdf=source.scene.urdf,
        stages=source.lived.stages,
        gripper=_recorded_grips(plan, source.events, job.start_ns)
        if source.executed
        else _planned_grips(plan),
        end_ns=source.end_ns,
        divergence=divergence,
        images=images,
    )


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
