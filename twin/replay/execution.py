"""The path of an executed replay: recorded joints and gripper widths, checked and cut."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from bridge.episode.streams import JointTrack
from bridge.episode.topics import GRIPPER_STATE, JOINT_STATES
from bridge.geometry.signals import runs_of_true
from bridge.robots.robot import GRIPPER_WIDTH, Robot
from bridge.task.plan import Plan, Stage
from twin.replay.config import ReplayConfig
from twin.replay.observed import PLATEAU_M, find_grips
from twin.replay.path import MAX_DURATION_S, WIDTH_SLACK_M, JointPath, UnusablePlanError

SQUEEZE_M = 0.01
"""How far below the recorded width an executed grasp is commanded, so that it presses [m]."""
LARGEST_GAP_NS = 500_000_000
"""What was not recorded for longer than this is not made up."""


def check_length(length_ns: int, plan_id: str) -> None:
    """Refuse an execution that took longer than any trajectory that is replayed."""
    if length_ns > MAX_DURATION_S * 1e9:
        raise UnusablePlanError(
            plan_id=plan_id,
            found=f"was executed for {length_ns * 1e-9:.0f} s",
            hint=f"At most {MAX_DURATION_S:.0f} s are replayed; split it.",
        )


def check_covers(track: JointTrack, what: str, end_ns: int, plan_id: str) -> None:
    """Refuse a track that stops well before the execution ended."""
    missing_ns = end_ns - int(track.stamps_ns[-1])
    if missing_ns > LARGEST_GAP_NS:
        raise _not_recorded(plan_id, what, missing_ns, "at its end")


def check_track(track: JointTrack, what: str, plan_id: str) -> None:
    """Refuse numbers that are none, and gaps."""
    wrong = ~np.isfinite(track.position).all(axis=1)
    if wrong.any():
        at_s = int(track.stamps_ns[int(np.argmax(wrong))] - track.stamps_ns[0]) * 1e-9
        raise UnusablePlanError(
            plan_id=plan_id,
            found=f"was executed with {what} that are no numbers at {at_s:.2f} s",
            hint=f"{int(wrong.sum())} of {len(wrong)} samples are concerned; look at their source.",
        )
    gaps_ns = np.diff(track.stamps_ns)
    if len(gaps_ns) and int(gaps_ns.max()) > LARGEST_GAP_NS:
        at_s = int(track.stamps_ns[int(gaps_ns.argmax())] - track.stamps_ns[0]) * 1e-9
        raise _not_recorded(plan_id, what, int(gaps_ns.max()), f"from {at_s:.1f} s on")


def gripper_widths(widths: JointTrack, plan: Plan, robot: Robot) -> JointTrack:
    """The recorded distances between the finger pads [m] alone, if that is what they are.

    UnusablePlanError: several joints of which none has the name, what ``check_track`` refuses, and
    numbers that no distance between these pads can be: radians, millimetres, percent.
    """
    names = widths.names
    if len(names) > 1 and GRIPPER_WIDTH not in names:
        raise UnusablePlanError(
            plan_id=plan.id,
            found=f"was recorded with several joints of the gripper: {', '.join(names)}",
            hint=f"Record one, {GRIPPER_WIDTH}: the distance between its pads in metres.",
        )
    column = names.index(GRIPPER_WIDTH) if GRIPPER_WIDTH in names else 0
    found = JointTrack(
        names=(GRIPPER_WIDTH,),
        stamps_ns=widths.stamps_ns,
        position=widths.position[:, column : column + 1],
    )
    check_track(found, "gripper widths", plan.id)
    low, high = float(found.position.min()), float(found.position.max())
    most_m = robot.gripper.max_width_m
    if low < -WIDTH_SLACK_M or high > most_m + WIDTH_SLACK_M:
        raise UnusablePlanError(
            plan_id=plan.id,
            found=f"was executed with gripper widths from {low:.3f} to {high:.3f}",
            hint=f"{GRIPPER_WIDTH} is the distance between the pads in metres, 0 to {most_m}.",
        )
    return found


def _not_recorded(plan_id: str, what: str, missing_ns: int, where: str) -> UnusablePlanError:
    return UnusablePlanError(
        plan_id=plan_id,
        found=f"was executed while no {what} were recorded for {missing_ns * 1e-9:.1f} s {where}",
        hint=f"Record {JOINT_STATES} and {GRIPPER_STATE} without gaps over the whole execution.",
    )


_AHEAD_NS, _CREEP_M = 100_000_000, 0.003
"""Fingers that close by less than this within a tenth of a second are stopped by something."""
_LATENESS_NS = 2_000_000_000
"""An execution may lag behind its plan by up to this long."""


def path_of_execution(
    track: JointTrack,  # its first sample is time 0 of the path
    widths: JointTrack,  # on the same clock
    plan: Plan,  # what was executed: says when the gripper was to be closed
    config: ReplayConfig,
    robot: Robot,
) -> JointPath:
    """Turn recorded tracks into a path that starts at time 0.

    A recorded grasp stops at the object's width. Commanding that width would touch without
    pressing, so while the plan wants the gripper closed and the fingers have stopped, the command
    is ``SQUEEZE_M`` narrower and the force limit holds the object. A kinematic replay shows the
    recorded width.

    UnusablePlanError: a track is empty, has gaps, names other joints, or holds what is no posture
    or no width.
    """
    if len(track.stamps_ns) == 0 or len(widths.stamps_ns) == 0:
        raise UnusablePlanError(
            plan_id=plan.id,
            found="was executed without recorded joints or gripper",
            hint=f"Record {JOINT_STATES} and {GRIPPER_STATE} over the whole execution.",
        )
    arm = in_order(track, robot, plan.id)
    check_track(arm, "joints", plan.id)
    widths = gripper_widths(widths, plan, robot)
    first_ns = int(track.stamps_ns[0])
    times, keep = np.unique(track.stamps_ns - first_ns, return_index=True)
    width_times, width_keep = np.unique(widths.stamps_ns - first_ns, return_index=True)
    width = widths.position[width_keep, 0].astype(np.float64)
    closed = closed_mask(width_times, width, plan)
    squeeze_m = SQUEEZE_M if config.mode == "dynamic" else 0.0
    return JointPath(
        times_ns=times,
        joints_rad=arm.position[keep].astype(np.float64),
        width_times_ns=width_times,
        width_m=np.where(closed, np.maximum(width - squeeze_m, 0.0), width),
        first_close_ns=next((closing for closing, _, _ in find_grips(width_times, width)), None),
    )


def in_order(track: JointTrack, robot: Robot, plan_id: str) -> JointTrack:
    """The robot's own joints alone, from base to hand."""
    missing = [name for name in robot.joints if name not in track.names]
    if missing:
        raise UnusablePlanError(
            plan_id=plan_id,
            found=f"was recorded without the joints {', '.join(missing)}",
            hint=f"The recording has {', '.join(track.names)}.",
        )
    order = [track.names.index(name) for name in robot.joints]
    return replace(track, names=robot.joints, position=track.position[:, order])


def cut_track(track: JointTrack, start_ns: int, end_ns: int) -> JointTrack:
    """An interval's samples (track's clock), with the interpolated value at its start put first.

    A sample at the end is not made up: where the recording stops early, so does the track.
    """
    inside = (track.stamps_ns > start_ns) & (track.stamps_ns <= end_ns)
    return JointTrack(
        names=track.names,
        stamps_ns=np.concatenate([[start_ns], track.stamps_ns[inside]]),
        position=np.concatenate([track.at(np.array([start_ns])), track.position[inside]]),
    )


def stages_as_executed(
    plan: Plan, events: Sequence[Mapping[str, Any]], start_ns: int
) -> tuple[Stage, ...]:
    """The plan's stages when the recording says they were; 0 is ``start_ns`` (source time)."""
    spans: dict[tuple[str, str], int] = {}
    for event in events:
        if event.get("plan_id") == plan.id and event["type"] in ("stage_started", "stage_ended"):
            key = (str(event["type"]), str(event.get("stage_id")))
            spans[key] = int(event["stamp_ns"]) - start_ns
    return tuple(
        replace(
            stage,
            t_start_ns=spans.get(("stage_started", stage.id), stage.t_start_ns),
            t_end_ns=spans.get(("stage_ended", stage.id), stage.t_end_ns),
        )
        for stage in plan.stages
    )


def closed_mask(
    times_ns: Int[np.ndarray, " num_samples"],  # ascending, from the start of the execution
    width_m: Float[np.ndarray, " num_samples"],  # between the finger pads
    plan: Plan,
) -> Bool[np.ndarray, " num_samples"]:
    """Say when the fingers were closed on something, from the plan's wish and their own motion."""
    closed = np.zeros(len(times_ns), dtype=bool)
    stamps = [*(waypoint.t_ns for waypoint in plan.tau), plan.tau[-1].t_ns + 1]
    for first, end in runs_of_true(np.array([waypoint.g == 1 for waypoint in plan.tau])):
        start_ns, end_ns = stamps[first], stamps[end]  # without an end, just past the plan's own
        window = np.flatnonzero((times_ns >= start_ns) & (times_ns <= end_ns + _LATENESS_NS))
        wide = np.maximum.accumulate(width_m[window])
        begun = width_m[window] < wide - PLATEAU_M
        # Something soft gives way for seconds: stopped is what hardly closes any further.
        ahead = np.interp(times_ns[window] + _AHEAD_NS, times_ns, width_m)
        stopped = window[begun & (width_m[window] - ahead < _CREEP_M)]
        if len(stopped):
            # One stretch: from where the fingers stop to where they leave that for good.
            rest = width_m[stopped[0] :]
            left = np.flatnonzero(rest > np.minimum.accumulate(rest) + PLATEAU_M)
            last = stopped[0] + left[0] if len(left) else window[-1] + 1
            closed[stopped[0] : last] = True
    return closed
