"""Remembers the messages a late listener needs: static transforms, the URDF, calibrations."""

from bridge.episode import cdr
from bridge.episode.records import transforms_from_cdr
from bridge.wire.session import WireSample

MAX_LATCHED = 1000
TF_STATIC = "/tf_static"


def is_latched(topic: str) -> bool:
    """Say whether the last message of a topic stays true until the next."""
    return topic in (TF_STATIC, "/robot_description") or topic.endswith("/info")


class LatchedMessages:
    """The last message of each latched topic; of ``/tf_static`` the last for each frame."""

    def __init__(self) -> None:
        """Start without messages."""
        self._kept: dict[tuple[str, frozenset[str]], WireSample] = {}

    def remember(self, sample: WireSample) -> None:
        """Keep a message if its topic is latched, in place of those it replaces."""
        if not is_latched(sample.topic):
            return
        frames = _children(sample) if sample.topic == TF_STATIC else frozenset()
        replaced = [key for key in self._kept if key[0] == sample.topic and key[1] <= frames]
        for key in replaced:
            del self._kept[key]
        if len(self._kept) < MAX_LATCHED:
            self._kept[sample.topic, frames] = sample

    def forget(self, prefix: str) -> None:
        """Drop the messages of topics that begin so: their publisher has gone."""
        for key in [key for key in self._kept if key[0].startswith(prefix)]:
            del self._kept[key]

    def all(self) -> list[WireSample]:
        """What to write at the start of an episode, oldest first."""
        return list(self._kept.values())


def _children(sample: WireSample) -> frozenset[str]:
    try:
        return frozenset(item.child for item in transforms_from_cdr(sample.data))
    except (cdr.MalformedMessageError, ValueError):
        return frozenset()
