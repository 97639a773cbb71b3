"""Recorded time that goes backwards: sorting it would make up an execution nobody saw."""

from collections.abc import Sequence

from bridge.episode import schema
from bridge.episode.reader import Episode
from twin.errors import TwinError

BACK_NS = 20_000_000
"""Messages of several publishers may overtake each other by this much."""


class BackwardTimeError(TwinError):
    """Nobody knows in which order an execution happened."""


def check_clock(
    episode: Episode, endings: Sequence[str], start_ns: int, end_ns: int, plan_id: str
) -> None:
    """Refuse an execution during which the source's clock went back.

    Args:
        episode: The recording.
        endings: Joint topics with these endings.
        start_ns: Source time at which the execution started.
        end_ns: And ended.
        plan_id: Whose execution it is.

    Raises:
        BackwardTimeError: Naming the topic, the instant and by how much; or an execution that took
            no time.
    """
    if end_ns <= start_ns:
        raise BackwardTimeError(
            f"the execution of plan {plan_id!r} ended {(start_ns - end_ns) * 1e-9:.2f} s before it "
            "started; look at the clock of the events"
        )
    topics = [
        topic
        for topic in episode.topics_of_type(schema.JOINT_STATE)
        if any(topic.endswith(ending) for ending in endings)
    ]
    latest: dict[str, int] = {}
    inside: set[str] = set()
    for message in episode.messages(topics):
        stamp_ns = message.publish_time_ns
        before_ns = latest.get(message.topic, stamp_ns)
        jumped = before_ns - stamp_ns > BACK_NS
        if jumped and message.topic in inside and stamp_ns <= end_ns:
            raise BackwardTimeError(
                f"the time of {message.topic} goes back by {(before_ns - stamp_ns) * 1e-9:.2f} s "
                f"at {max(0, before_ns - start_ns) * 1e-9:.2f} s of plan {plan_id!r}; the "
                "execution is not known in its right order"
            )
        if start_ns <= stamp_ns <= end_ns:
            inside.add(message.topic)
        latest[message.topic] = stamp_ns if jumped else max(before_ns, stamp_ns)
