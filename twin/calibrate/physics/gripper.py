"""What the gripper of a recorded trial was told, how wide it was, and when it held something."""

import numpy as np
from jaxtyping import Bool, Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.errors import GstError
from bridge.task.plan import Plan
from bridge.task.robot import MAX_WIDTH_M
from twin.calibrate.physics.case import UnusableCaseError

HELD_M = 0.002
"""Fingers that stop this far above what they were told hold something."""
HELD_S = 0.15
STILL_M = 3e-4

Series = tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]
"""Times [s] and widths [m]."""


def commands_of(episode: Episode, plan: Plan, start_ns: int) -> Series:
    """What the gripper was told and when [s, m]: from events, else from the plan."""
    times, widths = [0.0], [MAX_WIDTH_M]
    for event in streams.events(episode):
        if event["type"] == "gripper" and event.get("plan_id") == plan.id:
            told = (event.get("data") or {}).get("width_m")
            shut = 0.0 if event.get("text") == "close" else MAX_WIDTH_M
            times.append((int(event["stamp_ns"]) - start_ns) * 1e-9)
            widths.append(shut if told is None else float(told))
    if len(times) == 1:
        for waypoint in plan.tau:
            shut = 0.0 if waypoint.g else MAX_WIDTH_M
            times.append(waypoint.t_ns * 1e-9)
            widths.append(shut if waypoint.width_m is None else waypoint.width_m)
    return np.array(times), np.array(widths)


def widths_of(episode: Episode, start_ns: int) -> Series:
    """Recorded opening [s, m]; empty where it was not recorded.

    Raises:
        UnusableCaseError: When a width is no number.
    """
    try:
        track = streams.joint_track(episode, "/gripper/state")
    except GstError:
        return np.zeros(0), np.zeros(0)
    if not np.isfinite(track.position).all():
        raise UnusableCaseError("gripper widths hold what is no number.")
    return (track.stamps_ns - start_ns) * 1e-9, track.position[:, 0].astype(np.float64)


def is_holding(
    times_s: Float[np.ndarray, " num_times"], commands: Series, widths: Series
) -> Bool[np.ndarray, " num_times"]:
    """When the fingers stand still on something; never where no width was recorded."""
    if not len(widths[0]):
        return np.zeros(len(times_s), dtype=bool)
    told = commands[1][np.searchsorted(commands[0], times_s, side="right") - 1]
    width = np.interp(times_s, *widths)
    still = np.abs(width - np.interp(times_s - HELD_S, *widths)) < STILL_M
    return np.asarray(still & (width > told + HELD_M))


def holds(commands: Series, widths: Series) -> Series:
    """Widths at which the fingers stood still on something, just before they were opened again."""
    times_s, width_m = widths
    held_at, held = [], []
    for index in np.flatnonzero(np.diff(commands[1]) > HELD_M) + 1:
        opened_s, told_m = commands[0][index], commands[1][index - 1]
        window = width_m[(times_s > opened_s - HELD_S) & (times_s <= opened_s)]
        if len(window) > 1 and np.ptp(window) < STILL_M and window.mean() > told_m + HELD_M:
            held_at.append(float(opened_s) - HELD_S / 2)
            held.append(float(window.mean()))
    return np.array(held_at), np.array(held)
