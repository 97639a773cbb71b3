"""Remembers the messages a late listener needs: static transforms, the URDF, calibrations."""

from bridge.episode import cdr
from bridge.episode.records import transforms_from_cdr
from bridge.wire.session import WireSample

MAX_LATCHED = 1000
MAX_LATCHED_BYTES = 256_000_000
"""Maps are large; a file that begins with more than this of the past is refused the rest."""
MAX_DECLARED = 1000
TF_STATIC = "/tf_static"
NOT_LATCHED = frozenset(("/rosout",))
"""Transient local in ROS 2, yet what was logged once does not stay true."""


def is_latched(topic: str) -> bool:
    """Say whether the last message of a topic stays true until the next."""
    return topic in (TF_STATIC, "/robot_description") or topic.endswith("/info")


class LatchedTopics:
    """The latched topics: those known by name, and those whose publishers say so."""

    def __init__(self) -> None:
        """Start with the names."""
        self._declared: set[str] = set()

    def __contains__(self, topic: str) -> bool:
        """Say whether the last message of a topic stays true until the next."""
        return topic in self._declared or is_latched(topic)

    def declare(self, topic: str) -> None:
        """Count a topic as latched from now on; may be called by any thread."""
        if topic not in NOT_LATCHED and len(self._declared) < MAX_DECLARED:
            self._declared.add(topic)


class LatchedMessages:
    """The last message of each publisher of a latched topic; of ``/tf_static`` of each frame."""

    def __init__(self, topics: LatchedTopics | None = None) -> None:
        """Start without messages."""
        self.topics = topics or LatchedTopics()
        self._kept: dict[tuple[str, frozenset[str]], WireSample] = {}
        self._bytes = 0

    def remember(self, sample: WireSample) -> None:
        """Keep a message if its topic is latched, in place of those it replaces."""
        if sample.topic not in self.topics:
            return
        what = _what(sample)
        self._drop([key for key in self._kept if key[0] == sample.topic and key[1] <= what])
        size = self._bytes + len(sample.data)
        if len(self._kept) < MAX_LATCHED and size <= MAX_LATCHED_BYTES:
            self._kept[sample.topic, what] = sample
            self._bytes = size

    def _drop(self, keys: list[tuple[str, frozenset[str]]]) -> None:
        for key in keys:
            self._bytes -= len(self._kept.pop(key).data)

    def forget(self, prefix: str) -> None:
        """Drop the messages of topics that begin so: their publisher has gone."""
        self._drop([key for key in self._kept if key[0].startswith(prefix)])

    def all(self) -> list[WireSample]:
        """What to write at the start of an episode, oldest first."""
        return list(self._kept.values())


def _what(sample: WireSample) -> frozenset[str]:
    """What a message speaks of: its frames, or by the names we know one thing, or its sender's."""
    if sample.topic == TF_STATIC:
        return _children(sample)
    if sample.source_gid is None or is_latched(sample.topic):
        return frozenset()
    return frozenset((sample.source_gid.hex(),))


def _children(sample: WireSample) -> frozenset[str]:
    try:
        return frozenset(item.child for item in transforms_from_cdr(sample.data))
    except (cdr.MalformedMessageError, ValueError):
        return frozenset()
