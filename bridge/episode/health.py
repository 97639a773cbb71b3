"""The health of an episode: what is wrong with it, each thing under one name.

The recorder fills the record while it records and keeps it in the episode; ``check`` finds the same
by reading. Status, stop, ``info`` and ``ls`` show it; exit codes follow from its severities.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from bridge.clock import NS_PER_S, s_from_ns
from bridge.episode import schema
from bridge.episode.cdr.batch import JointLayout, joint_layout
from bridge.episode.cdr.messages import DepthImage
from bridge.episode.topics import DEPTH_IMAGE
from bridge.errors import BridgeError

RECORD_NAME = "health"
"""Of the metadata record that holds what the recorder found."""
NAMES = (
    *("contract_broken", "drops_not_logged", "drops_logged", "cut_short", "tail_unknown"),
    *("recovered", "rate_collapsed", "frozen_image", "empty_depth", "nan_joints", "stamp_zero"),
    *("stamp_stuck", "odd_times", "clock_jump", "host_clock_jump", "deaf", "unreadable"),
    *("mixed_types", "tail_untold", "nothing_recorded"),
)
"""Every name; of several the first stands for all. With one of them an episode is not clean."""


@dataclass(frozen=True, kw_only=True)
class HealthFinding:
    """One thing that is wrong, and when it was so."""

    name: str
    about: str
    """The topic, clock or file."""
    text: str
    first_ns: int = 0
    """First and last instant, by the recorder's clock; 0 where it has none."""
    last_ns: int = 0
    count: int = 1

    def line(self, start_ns: int = 0) -> str:
        """What is printed, with seconds after the start where that is known."""
        text = f"{in_words(self.name)}: {self.about}: {self.text}"
        if not start_ns or not self.first_ns:
            return text
        first_s, last_s = (s_from_ns(at - start_ns) for at in (self.first_ns, self.last_ns))
        more = "" if first_s == last_s else f" to {last_s:.1f}"
        return f"{text} (at {first_s:.1f}{more} s)"


def drops_logged(topic: str, lost: int) -> HealthFinding:
    """Say what of a topic was lost, and is in the drop log."""
    return HealthFinding(name="drops_logged", about=topic, text=f"{lost} messages")


def unreadable(topic: str, count: int, messages: int, why: str) -> HealthFinding:
    """Say how many of a topic's messages cannot be read."""
    text = f"{count} of {messages} messages cannot be read: {why}"
    return HealthFinding(name="unreadable", about=topic, text=text)


def mixed_types(topic: str, types: Collection[str], **span: int) -> Iterator[HealthFinding]:
    """Say that a topic carries several types, if it does."""
    if len(types) > 1:
        text = " and ".join(sorted(name or "no type" for name in types))
        yield HealthFinding(name="mixed_types", about=topic, text=text, **span)


def in_order(findings: Iterable[HealthFinding]) -> list[HealthFinding]:
    """The worst first, then by time; one of each name and topic."""
    kept = {(each.name, each.about, each.text): each for each in findings}
    return sorted(
        kept.values(), key=lambda each: (NAMES.index(each.name), each.first_ns, each.about)
    )


def in_words(name: str) -> str:
    """A name for people."""
    return name.replace("_", " ")


def parsed(value: object) -> list[HealthFinding]:
    """Read findings as they stand in a record; anything else is none."""
    try:
        return msgspec.convert(value, list[HealthFinding])
    except msgspec.ValidationError:
        return []


_IMAGES = (schema.IMAGE, schema.COMPRESSED_IMAGE)
_STAMPED = (*_IMAGES, schema.JOINT_STATE, schema.POSE_STAMPED)
_UNSET = bytes(8)
_FRONT, _SAMPLES, _SMALL = 128, 64, 4096
_LONG_ENOUGH = {
    "stamp_zero": (20, 0, "header.stamp is 0"),
    "stamp_stuck": (20, NS_PER_S, "header.stamp stays the same"),
    "frozen_image": (20, NS_PER_S, "every pixel stays the same"),
    "empty_depth": (5, 0, "every pixel is 0"),
    "nan_joints": (1, 0, "a position is not a number"),
}
"""How many messages in a row, over what time, and what is said of them."""


BLIND_NS = 3 * NS_PER_S
"""A depth camera that has measured sees nothing for so long where a hand is close before it."""


class ContentWatch:
    """Follows what the messages of one topic hold; to decode each would cost more than writing."""

    def __init__(self, topic: str, type_name: str) -> None:
        """Choose what to look at."""
        self.findings: dict[str, HealthFinding] = {}
        self.is_of_use = type_name in _STAMPED
        self._topic, self._type = topic, type_name
        self._is_image = type_name in _IMAGES
        self._is_depth = self._is_image and topic.endswith(DEPTH_IMAGE)
        self._is_joints = type_name == schema.JOINT_STATE
        self._joints: JointLayout | None = None
        self._runs: dict[str, list[int]] = {}
        """Where each run began, how long it is, and how much of it is in a finding."""
        self._stamp, self._key, self._data, self._has_measured = b"", b"", b"", False

    def knows(self, data: bytes) -> bool:
        """Whether it is of joints that were read before, so that nothing of it can be broken."""
        return self._joints is not None and self._joints.is_like(data)

    def see(self, data: bytes, log_ns: int, *, is_known: bool = False) -> HealthFinding | None:
        """Take the next message; return what has just become remarkable."""
        stamp, now = data[4:12], []
        if stamp == self._stamp:
            now.append("stamp_zero" if stamp == _UNSET else "stamp_stuck")
        self._stamp = stamp
        if self._is_joints:
            if not is_known and not self.knows(data):
                self._joints = joint_layout(data)
            if self._joints is not None and self._joints.has_nan(data):
                now.append("nan_joints")
        elif self._is_image:
            key = data[_FRONT :: len(data) // _SAMPLES + 1]
            is_suspect = self._is_depth and (len(data) < _SMALL or len(set(key)) <= 4)
            if is_suspect and _is_empty(self._type, data):
                now.append("empty_depth")
            elif key == self._key and data[12:] == self._data[12:]:
                now.append("frozen_image")
            self._has_measured |= "empty_depth" not in now
            self._key, self._data = key, data
        if now or self._runs:
            return self._follow(now, log_ns)
        return None

    def _follow(self, now: list[str], log_ns: int) -> HealthFinding | None:
        new = None
        self._runs = {name: self._runs.get(name, [log_ns, 0, 0]) for name in now}
        for name, run in self._runs.items():
            least, span_ns, text = _LONG_ENOUGH[name]
            if name == "empty_depth" and self._has_measured:
                span_ns = BLIND_NS
            run[1] += 1
            if run[1] < least or log_ns - run[0] < span_ns:
                continue
            before = self.findings.get(name)
            first_ns, count = (before.first_ns, before.count) if before else (run[0], 0)
            found = self.findings[name] = HealthFinding(
                name=name, about=self._topic, text=text, first_ns=first_ns, last_ns=log_ns,
                count=count + run[1] - run[2],
            )  # fmt: skip
            run[2] = run[1]
            new = new if before else found
        return new


def _is_empty(type_name: str, data: bytes) -> bool:
    try:
        return not DepthImage.from_message(type_name, data).depth_mm.any()
    except BridgeError:
        return False


_SET = {"clock_jump": "clock_jump", "stamp_jump": "clock_jump", "deaf": "deaf"}
"""Kinds of notes that a recorder writes among the events, and what they are here."""


def of_event(event: Mapping[str, Any]) -> Iterator[HealthFinding]:
    """Read what the recorder noticed of clocks and of its own hearing."""
    at_ns, data, text = event.get("stamp_ns", 0), event.get("data"), str(event.get("text", ""))
    data = data if isinstance(data, dict) else {}
    name, about = _SET.get(str(data.get("kind")), ""), data.get("source")
    if event.get("type") == "clock_step" and isinstance(data.get("step_ns"), int):
        by_s, name, about = data["step_ns"] / NS_PER_S, "host_clock_jump", "recorder"
        text = f"set {'ahead' if by_s > 0 else 'back'} by {abs(by_s):.3f} s; log times go on"
    elif event.get("type") != "note" or not name:
        return
    topics = data.get("topics")
    about = about or (topics[0] if isinstance(topics, list) and topics else "recorder")
    yield HealthFinding(name=name, about=str(about), text=text, first_ns=at_ns, last_ns=at_ns)
