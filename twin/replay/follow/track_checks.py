"""What recorded joints and gripper widths must be, so that an execution can be replayed."""

import numpy as np

from bridge.episode.streams import JointTrack
from bridge.task.plan import Plan
from bridge.task.robot import MAX_WIDTH_M
from twin.replay.follow.usable import MAX_DURATION_S, WIDTH_SLACK_M, UnusablePlanError

GRIPPER_WIDTH = "gripper_width"
"""The one joint on /gripper/state (docs/episode_format.md)."""
LARGEST_GAP_NS = 500_000_000
"""What was not recorded for longer than this is not made up."""


def check_length(length_ns: int, plan: Plan) -> None:
    """Refuse an execution that took longer than any trajectory that is replayed.

    Raises:
        UnusablePlanError: Saying how long.
    """
    if length_ns > MAX_DURATION_S * 1e9:
        raise UnusablePlanError(
            plan_id=plan.id,
            found=f"was executed for {length_ns * 1e-9:.0f} s",
            hint=f"At most {MAX_DURATION_S:.0f} s are replayed; split it.",
        )


def check_covers(track: JointTrack, what: str, end_ns: int, plan: Plan) -> None:
    """Refuse a track that stops well before the execution ended.

    Args:
        track: Cut to the execution.
        what: What it holds, as it is said: joints, gripper widths.
        end_ns: When the execution ended.
        plan: What was executed.

    Raises:
        UnusablePlanError: Saying how much is missing.
    """
    missing_ns = end_ns - int(track.stamps_ns[-1])
    if missing_ns > LARGEST_GAP_NS:
        raise _not_recorded(plan, what, missing_ns, "at its end")


def check_track(track: JointTrack, what: str, plan: Plan) -> None:
    """Refuse numbers that are none, and gaps.

    Args:
        track: Cut to the execution.
        what: What it holds, as it is said.
        plan: What was executed.

    Raises:
        UnusablePlanError: Saying where.
    """
    wrong = ~np.isfinite(track.position).all(axis=1)
    if wrong.any():
        at_s = int(track.stamps_ns[int(np.argmax(wrong))] - track.stamps_ns[0]) * 1e-9
        raise UnusablePlanError(
            plan_id=plan.id,
            found=f"was executed with {what} that are no numbers at {at_s:.2f} s",
            hint=f"{int(wrong.sum())} of {len(wrong)} samples are concerned; look at their source.",
        )
    gaps_ns = np.diff(track.stamps_ns)
    if len(gaps_ns) and int(gaps_ns.max()) > LARGEST_GAP_NS:
        at_s = int(track.stamps_ns[int(gaps_ns.argmax())] - track.stamps_ns[0]) * 1e-9
        raise _not_recorded(plan, what, int(gaps_ns.max()), f"from {at_s:.1f} s on")


def gripper_widths(widths: JointTrack, plan: Plan) -> JointTrack:
    """The recorded distances between the finger pads [m] alone, if that is what they are.

    Raises:
        UnusablePlanError: For several joints of which none has the name, for what ``check_track``
            refuses, and for numbers that no distance between these pads can be: radians,
            millimetres, percent.
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
    check_track(found, "gripper widths", plan)
    low, high = float(found.position.min()), float(found.position.max())
    if low < -WIDTH_SLACK_M or high > MAX_WIDTH_M + WIDTH_SLACK_M:
        raise UnusablePlanError(
            plan_id=plan.id,
            found=f"was executed with gripper widths from {low:.3f} to {high:.3f}",
            hint=f"{GRIPPER_WIDTH} is the distance between the pads in metres, 0 to {MAX_WIDTH_M}.",
        )
    return found


def _not_recorded(plan: Plan, what: str, missing_ns: int, where: str) -> UnusablePlanError:
    return UnusablePlanError(
        plan_id=plan.id,
        found=f"was executed while no {what} were recorded for {missing_ns * 1e-9:.1f} s {where}",
        hint="Record /joint_states and /gripper/state without gaps over the whole execution.",
    )
