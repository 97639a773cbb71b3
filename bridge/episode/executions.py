"""When an episode's robot executed something: as its events say, else as its joints show.

A learned policy, a person at a teach pendant and an imported log publish no plan and no events.
Then everything from the joints' first motion to their last is one execution, of ``NO_PLAN``.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack
from bridge.episode.topics import GRIPPER_STATE, JOINT_STATES
from bridge.errors import GstError

NO_PLAN = "no-plan"
"""Stands where the id of a plan would: what was executed, nobody had announced."""
EXECUTION = ("execution_started", "execution_ended")

_MOVED = 0.002
"""A joint this far from where it rested has moved [rad or m], unless its encoder is noisier."""
_CLEARLY_MOVED = 0.02
"""Farther than any noise: who is recorded from the middle of a motion on has moved too."""
_STILL = 0.0003
"""And this near to it had not moved yet."""
_REST_NS = 200_000_000
"""Where a joint rests is its median over so long at either end."""
_NOISE = 6.0
"""What lies within so many standard deviations of a joint's noise is no motion."""


def whose(plan_id: str) -> str:
    """What was executed, as messages name it."""
    return "the motion" if plan_id == NO_PLAN else f"plan {plan_id!r}"


def motion_ns(*tracks: JointTrack) -> tuple[int, int] | None:
    """Source times of the first and the last motion of any joint; None where nothing moved.

    The first motion begins when the joints were last at rest before one of them leaves its place
    by 2 mrad (or mm); the last one ends likewise, looked at from the end.
    """
    found = [each for track in tracks if (each := _motion_of(track)) is not None]
    if not found:
        return None
    return min(start for start, _ in found), max(end for _, end in found)


def _motion_of(track: JointTrack) -> tuple[int, int] | None:
    known = np.isfinite(track.position).all(axis=1)
    stamps_ns, position = track.stamps_ns[known], track.position[known]
    if len(stamps_ns) < 2:
        return None
    first = _left_rest(position, stamps_ns - stamps_ns[0] <= _REST_NS)
    last = _left_rest(position[::-1], stamps_ns[-1] - stamps_ns[::-1] <= _REST_NS)
    if first is None or last is None:
        return None
    return int(stamps_ns[first]), int(stamps_ns[len(stamps_ns) - 1 - last])


def _left_rest(
    position: Float[np.ndarray, "num_samples num_joints"], resting: Bool[np.ndarray, " num_samples"]
) -> int | None:
    """The last sample at rest before a joint is clearly elsewhere; None: none ever is."""
    away = np.abs(position - np.median(position[resting], axis=0))
    noise = np.std(position[resting], axis=0)
    moved = (away > np.clip(_NOISE * noise, _MOVED, _CLEARLY_MOVED)).any(axis=1)
    if not moved.any():
        return None
    still = (away <= np.clip(_NOISE / 2 * noise, _STILL, _MOVED)).all(axis=1)
    before = np.flatnonzero(still[: int(np.argmax(moved))])
    return int(before[-1]) if len(before) else 0


def executed_events(episode: Episode) -> list[dict[str, Any]]:
    """All events, and the execution that the joints show where nobody announced one."""
    return with_execution(episode, streams.events(episode))


def with_execution(episode: Episode, events: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Add start and end of an execution that no event tells of.

    A trial of a known task that carries no plan and says nothing of executions gets one of
    ``NO_PLAN``. One that says when, but not of which plan, keeps its times.
    """
    found = [dict(event) for event in events]
    if any(event["type"] == EXECUTION[0] for event in found):
        for event in found:
            if event.get("plan_id") is None and event["type"] != "label":
                event["plan_id"] = NO_PLAN
        return found
    if not is_without_plan(episode):
        return found
    tracks = []
    for ending in (JOINT_STATES, GRIPPER_STATE):
        with suppress(GstError):  # not recorded, or damaged: whoever needs it says so
            tracks.append(streams.joint_track(episode, ending))
    moved = motion_ns(*tracks)
    if moved is None:
        return found
    return found + [
        {
            "schema_version": 1,
            "stamp_ns": stamp_ns,
            "type": kind,
            "plan_id": NO_PLAN,
            "text": "found from the joints",
        }
        for kind, stamp_ns in zip(EXECUTION, moved, strict=True)
    ]


def is_without_plan(episode: Episode) -> bool:
    """Whether it is a trial of a task in which nobody published a plan."""
    info = episode.info
    if info.kind != "trial" or not info.task:
        return False
    topics = episode.topics()
    return not any(topics[name].count for name in episode.topics_of_type(schema.PLAN))
