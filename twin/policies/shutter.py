"""When a cell's cameras take pictures, and how late these are there: policies see the past."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import color_from_message
from bridge.episode.reader import Episode
from bridge.episode.topics import COLOR_IMAGE, JOINT_STATES

Stamps = Int[np.ndarray, " _"]


@dataclass(frozen=True, kw_only=True)
class Shutter:
    """Of one camera. Times count from a start; by itself it is open always."""

    first_ns: int = 0
    """When a picture is taken."""
    period_ns: int = 1
    late_ns: int = 0
    """From when it is taken to when it is there."""

    def newest_ns(self, t_ns: int) -> int:
        """When the newest picture was taken that is there at an instant."""
        count = (t_ns - self.late_ns - self.first_ns) // self.period_ns
        return self.first_ns + count * self.period_ns


ALWAYS = Shutter()


def shutter_of(episode: Episode, camera_id: str, start_ns: int) -> Shutter:
    """How a camera took pictures in an episode.

    How late they were there is told by the joint states that had come before them, so that the
    recorder's clock does not matter.
    """
    topic = streams.find_camera_topic(episode, camera_id, COLOR_IMAGE[1:])
    states = [t for t in episode.topics_of_type(schema.JOINT_STATE) if t.endswith(JOINT_STATES)]
    pictures = () if topic is None else episode.messages([topic])
    taken_ns, came_ns = _columns(
        (color_from_message(each.type_name, each.data).stamp_ns, each.log_time_ns)
        for each in pictures
    )
    messages = episode.messages(states) if states else ()
    joints_ns, joints_came_ns = _columns((m.publish_time_ns, m.log_time_ns) for m in messages)
    if len(taken_ns) < 2 or not len(joints_ns):
        return ALWAYS
    order = np.argsort(joints_came_ns, kind="stable")
    newest_ns = np.maximum.accumulate(joints_ns[order])
    known = np.searchsorted(joints_came_ns[order], came_ns) - 1
    late_ns = (newest_ns[known] - taken_ns)[known >= 0]
    before = taken_ns[taken_ns <= start_ns]
    return Shutter(
        first_ns=int(before.max() if len(before) else taken_ns.min()) - start_ns,
        period_ns=max(1, round(float(np.median(np.diff(np.sort(taken_ns)))))),
        late_ns=max(0, round(float(np.median(late_ns)))) if len(late_ns) else 0,
    )


def _columns(pairs: Iterable[tuple[int, int]]) -> tuple[Stamps, Stamps]:
    """When messages say that they were made, and when they were recorded."""
    made_ns, came_ns = np.array(list(pairs), dtype=np.int64).reshape(-1, 2).T
    return made_ns, came_ns
