"""The newest trial of a task that failed, as a refusal: where its objects were measured to end."""

import numpy as np

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.task.plan_request import Refusal
from bridge.task.task_file import Task
from bridge.task.verdict import Factor, Verdict
from twin.plan.loop.steer import tried_in
from twin.plan.loop.tau import goals_of
from twin.plan.problem import Miss, Pose
from twin.plan.release.resting import same_turns
from twin.scene.localise.episode import localise_episode, quiet_phases
from twin.scene.localise.mesh_fit import scanned_surfaces
from twin.scene.localise.stationary_frames import calibrated_cameras
from twin.scene.store.calibration import read_calibration


def missed_before(run: RunFolder, task: Task, task_sha256: str) -> tuple[Refusal, ...]:
    """One refusal where a failed trial shows how far its plan missed; nothing where none does."""
    for path in run.episodes()[::-1]:
        try:
            episode = Episode.open(path)
            outcome = outcome_of(run, episode)
            if episode.info.task_sha256 != task_sha256 or outcome is None:
                continue
            if outcome.result != "failure":
                return ()  # what was wrong before no longer is
            return _refusal(run, episode, task)
        except GstError:
            continue  # an episode that cannot be read tells nothing
    return ()


def _refusal(run: RunFolder, episode: Episode, task: Task) -> tuple[Refusal, ...]:
    phase = quiet_phases(episode)[-1]
    plan = {plan.id: plan for _, plan in streams.plans(episode)}.get(phase.plan_id or "")
    if plan is None:
        return ()
    found = localise_episode(
        episode, task, after_ns=phase.after_ns, before_ns=phase.before_ns,
        surfaces=scanned_surfaces(run, task).surfaces,
        poses=calibrated_cameras(episode, read_calibration(run)),
    )  # fmt: skip
    ends: dict[str, Pose] = {}
    far_m: dict[str, float] = {}
    for tried in tried_in(plan):
        key, T_meant = tried.object_id, tried.T_base_object
        T_end = found[key].T_base_object if key in found else None
        if T_meant is None or T_end is None or not goals_of(task, key):
            continue
        turns = T_end[:3, :3] @ same_turns(task.objects[key])
        ends[key] = T_end.copy()
        away_rad = se3.rotation_angle_rad(T_meant[:3, :3].T @ turns)
        ends[key][:3, :3] = turns[int(np.argmin(away_rad))]
        far_m[key] = float(np.linalg.norm(Miss.measured(T_meant, ends[key]).shift_m))
    if not ends:
        return ()
    worst, yes = max(far_m, key=lambda key: far_m[key]), Factor(value=True)
    terminal = Factor(value=False, cause=str(goals_of(task, worst)[0]["kind"]), bodies=(worst,))
    grasps = tuple(
        {"object": key, "held": True, "T_base_object": se3.pose_record(T)}
        for key, T in ends.items()
    )
    verdict = Verdict(
        plan_id=plan.id, trajectory="executed", mode="dynamic", ik=yes, clearance=yes,
        terminal=terminal, engine="measured", seed=0, grasps=grasps,
    )  # fmt: skip
    return (Refusal(plan=plan, verdict=verdict),)
