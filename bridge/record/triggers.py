"""Rules that record by themselves: what happened, with the seconds before it and after it.

A rule watches a topic. When it fires while nothing is recorded, an episode begins with the
pre-roll and ends ``post_s`` later; while an operator records, the instant is marked in that
episode. A rule about a level (force, joint error, silence) fires again once the level was left.
"""

import difflib
import json
import math
import threading
import time
import tomllib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr.codec import MalformedMessageError, decode
from bridge.episode.cdr.messages import JointSample
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import EPISODE_ID
from bridge.episode.topics import JOINT_STATES, JOINT_TARGETS, VERDICT, WRENCH
from bridge.errors import GstError, UsageError
from bridge.record.config import EpisodeAbout
from bridge.record.control import parse_info
from bridge.record.presence import News
from bridge.record.recorder import Recorder
from bridge.wire.keys import topic_pattern
from bridge.wire.session import WireSample

TRIGGERS_FILE = "triggers.toml"
SCHEMA_VERSION = 1
TAG = "trigger"
"""Every episode that a rule recorded has it, and a second tag, the rule's name."""
KINDS = ("verdict.refused", "force", "joint_error", "silence", "message")
POLL_S = 0.02
MAX_WAITING = 10_000
"""Messages of watched topics that wait; the oldest go first."""
LEAVES_AT = 0.8
"""A level is left below this part of its limit, so that noise at the limit fires once."""


class TriggerError(UsageError):
    """A file of rules cannot be used."""


@dataclass(frozen=True, kw_only=True)
class Rule:
    """One ``[[trigger]]`` of the file."""

    name: str
    """Begins the names of its episodes."""
    on: str
    """verdict.refused, force, joint_error, silence or message."""
    topic: str = ""
    """Topic or key expression (``/lab/estop``, ``lab/**``); left out: whatever carries it."""
    above: float | None = None
    """Limit: force [N], or distance of a joint from its target [rad]."""
    for_s: float | None = None
    """Silence of the topic [s]."""
    post_s: float = 3.0
    """Recorded after the last time it fired [s]."""
    rearm_s: float = 0.0
    """Fires again this long after its episode ended, at the earliest [s]."""


_NEEDS = {"force": ("above",), "joint_error": ("above",), "silence": ("topic", "for_s")}
_NEEDS["message"] = ("topic",)
_POSITIVE = ("above", "for_s", "post_s", "rearm_s")


def read_triggers(path: Path) -> list[Rule]:
    """Read the rules of a TOML file.

    Raises:
        TriggerError: Naming the rule and the key that cannot be, what is allowed, what is near.
    """
    try:
        values = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise TriggerError(f"the triggers {path} cannot be read: {error}.") from error
    except tomllib.TOMLDecodeError as error:
        raise TriggerError(f"the triggers {path} are no TOML: {error}.") from error
    _refuse_unknown(values, ("schema_version", "trigger"), where=str(path))
    if values.get("schema_version") != SCHEMA_VERSION:
        raise TriggerError(f"{path}: schema_version must be {SCHEMA_VERSION}.")
    tables = values.get("trigger")
    if not isinstance(tables, list) or not tables:
        raise TriggerError(f"{path}: it has no rule; each begins with [[trigger]].")
    rules = [_rule(table, f"{path}: trigger {k}") for k, table in enumerate(tables, start=1)]
    names = [rule.name for rule in rules]
    for name in names:
        if names.count(name) > 1:
            raise TriggerError(f"{path}: two rules are called {name!r}. Rename one.")
    return rules


def _rule(values: Any, where: str) -> Rule:
    if not isinstance(values, dict):
        raise TriggerError(f"{where} must be a table, got {values!r:.40}.")
    _refuse_unknown(values, [item.name for item in fields(Rule)], where=where)
    for key in ("name", "on", "topic"):
        value = values.get(key, None if key != "topic" else "")
        if not isinstance(value, str):
            raise TriggerError(f"{where}: {key} must be a text, got {value!r:.40}.")
    if not EPISODE_ID.fullmatch(values["name"]) or len(values["name"]) > 60:
        raise TriggerError(
            f"{where}: name {values['name']!r:.80} names files: use letters, digits, '_' and '-', "
            "at most 60."
        )
    kind = values["on"]
    if kind not in KINDS:
        raise TriggerError(
            f"{where}: on = {kind!r:.40} is not known. Known: {', '.join(KINDS)}."
            f"{_meant(kind, KINDS)}"
        )
    for key in _NEEDS.get(kind, ()):
        if not values.get(key):
            raise TriggerError(f"{where}: on = {kind!r} needs {key}.")
    numbers: dict[str, Any] = {}
    for key in _POSITIVE:
        value = values.get(key)
        if value is None:
            continue
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not 0 <= value < math.inf:
            raise TriggerError(f"{where}: {key} must be a number from 0 up, got {value!r:.40}.")
        numbers[key] = float(value)
    rule = Rule(name=values["name"], on=kind, topic=values.get("topic", ""))
    return replace(rule, **numbers)


def _refuse_unknown(
    values: Mapping[str, Any], allowed: "list[str] | tuple[str, ...]", *, where: str
) -> None:
    for key in values:
        if key not in allowed:
            raise TriggerError(
                f"{where}: the key {key} is not known. Allowed: {', '.join(allowed)}."
                f"{_meant(key, allowed)}"
            )


def _meant(word: str, allowed: "list[str] | tuple[str, ...]") -> str:
    nearest = difflib.get_close_matches(word, allowed, n=1, cutoff=0.5)
    return f" Did you mean {nearest[0]}?" if nearest else ""


_ENDINGS = {
    "verdict.refused": (VERDICT,),
    "force": (WRENCH,),
    "joint_error": (JOINT_STATES, JOINT_TARGETS),
}


class Watch:
    """Follows one rule. Gives the reason each time it fires."""

    def __init__(self, rule: Rule) -> None:
        """Arm it."""
        self.rule = rule
        self.fired = 0
        self._matches = topic_pattern(rule.topic).fullmatch if rule.topic else None
        self._endings = _ENDINGS.get(rule.on, ())
        self._targets: dict[str, dict[str, float]] = {}
        self._is_beyond = False

    def wants(self, topic: str) -> bool:
        """Say whether messages of a topic matter to it."""
        if self.rule.on == "silence":
            return False
        if self._matches is None:
            return topic.endswith(self._endings)
        if self.rule.on == "joint_error" and topic.endswith(JOINT_TARGETS):
            topic = topic.removesuffix(JOINT_TARGETS) + JOINT_STATES
        return self._matches(topic) is not None

    def see(self, sample: WireSample) -> str:
        """Look at a message; return why the rule fires, or ""."""
        try:
            return self._look(sample)
        except (MalformedMessageError, ValueError, TypeError, KeyError, RecursionError):
            return ""  # the recorder counts it as undecodable

    def _look(self, sample: WireSample) -> str:
        kind = self.rule.on
        if kind == "message":
            return f"a message on {sample.topic}"
        if kind == "verdict.refused":
            record = json.loads(sample.data)
            if not isinstance(record, dict) or record.get("accepted") is not False:
                return ""
            return f"the verdict on plan {record.get('plan_id', '')!s:.60} is no"
        if kind == "force":
            force = decode(schema.WRENCH_STAMPED, sample.data)["wrench"]["force"]
            newtons = math.sqrt(sum(float(force[axis]) ** 2 for axis in "xyz"))
            return self._level(newtons, f"force {newtons:.1f} N on {sample.topic}")
        return self._joint_error(sample)

    def _joint_error(self, sample: WireSample) -> str:
        joints = JointSample.from_cdr(sample.data)
        of_cell, _, _ = sample.topic.rpartition("/")
        here = dict(zip(joints.names, np.asarray(joints.position).tolist(), strict=False))
        if sample.topic.endswith(JOINT_TARGETS):
            self._targets[of_cell] = here
            return ""
        target = self._targets.get(of_cell, {})
        off = {name: abs(here[name] - target[name]) for name in here.keys() & target.keys()}
        if not off:
            return ""
        worst = max(off, key=lambda name: off[name])
        return self._level(off[worst], f"{worst} is {off[worst]:.3f} rad from its target")

    def silence(self, silent_s: Mapping[str, float]) -> str:
        """Look at how long topics have been silent [s]; return why the rule fires, or ""."""
        if self.rule.on != "silence" or self._matches is None or self.rule.for_s is None:
            return ""
        found = [(each_s, topic) for topic, each_s in silent_s.items() if self._matches(topic)]
        longest_s, topic = max(found, default=(0.0, ""))
        return self._level(longest_s, f"{topic} silent for {longest_s:.1f} s")

    def _level(self, value: float, text: str) -> str:
        limit = self.rule.for_s if self.rule.on == "silence" else self.rule.above
        if limit is None or not math.isfinite(value):
            return ""
        was_beyond = self._is_beyond
        self._is_beyond = value > limit * (LEAVES_AT if was_beyond else 1.0)
        return text if self._is_beyond and not was_beyond else ""


@dataclass
class _Open:
    """An episode that a rule has begun."""

    episode: str
    rule: Rule
    ends_s: float


@dataclass
class Triggers:
    """Rules at work, on a thread of their own; the network thread only hands over."""

    recorder: Recorder
    rules: list[Rule]
    about: EpisodeAbout = field(default_factory=EpisodeAbout)
    """What its episodes are."""
    say: Callable[[str], None] = lambda text: None
    now_s: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        """Refuse what cannot work, and arm all rules.

        Raises:
            TriggerError: Without a pre-roll.
        """
        if not self.recorder.config.preroll_s:
            raise TriggerError("triggers need the seconds before: add --preroll-s 5.")
        self._watches = [Watch(rule) for rule in self.rules]
        self._wanted: dict[str, list[Watch]] = {}
        self._waiting: deque[WireSample] = deque(maxlen=MAX_WAITING)
        self._open: _Open | None = None
        self._rearmed_s: dict[str, float] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="triggers", daemon=True)

    def begin(self) -> None:
        """Start the thread."""
        self._thread.start()

    def receive(self, sample: WireSample) -> None:
        """Take a message; on the network thread."""
        wanted = self._wanted.get(sample.topic)
        if wanted is None:
            wanted = [watch for watch in self._watches if watch.wants(sample.topic)]
            if len(self._wanted) < MAX_WAITING:
                self._wanted[sample.topic] = wanted
        if wanted:
            self._waiting.append(sample)

    def status(self) -> list[dict[str, Any]]:
        """How often each rule has fired, and what it records now."""
        episode = self._open
        return [
            {
                "name": watch.rule.name,
                "on": watch.rule.on,
                "fired": watch.fired,
                "recording": episode.episode if episode and episode.rule is watch.rule else None,
            }
            for watch in self._watches
        ]

    def _work(self) -> None:
        while not self._ended.wait(POLL_S):
            self.step()

    def step(self) -> None:
        """Look at all that has come in since the last call, and at the time."""
        while self._waiting:
            sample = self._waiting.popleft()
            for watch in self._wanted.get(sample.topic, ()):
                if why := watch.see(sample):
                    self._fire(watch, why, sample.received_ns)
        silent_s = self.recorder.presence.quiet()
        for watch in self._watches:
            if why := watch.silence(silent_s):
                self._fire(watch, why, None)
        if self._open is not None and self.now_s() >= self._open.ends_s:
            self._stop(self._open)

    def _fire(self, watch: Watch, why: str, at_ns: int | None) -> None:
        rule = watch.rule
        now_s = self.now_s()
        if self._open is None and now_s < self._rearmed_s.get(rule.name, 0.0):
            return
        watch.fired += 1
        text = f"trigger {rule.name}: {why}"
        try:
            if self._open is not None and self.recorder.recording == self._open.episode:
                self._open.ends_s = max(self._open.ends_s, now_s + rule.post_s)
            elif self.recorder.recording is None:
                info = self._info(rule)
                self.recorder.start(info, anyway=True)
                self._open = _Open(info.id, rule, now_s + rule.post_s)
                text += f"; records {info.id}"
        except GstError as error:
            text += f"; nothing is recorded: {error}"
        data = {"kind": "trigger", "rule": rule.name, "why": why}
        told = data if at_ns is None else {**data, "message_received_ns": at_ns}
        self.recorder.note(News(text=text, data=told))

    def _info(self, rule: Rule) -> EpisodeInfo:
        at = datetime.now(UTC)
        name = f"{rule.name}_{at:%Y%m%d_%H%M%S}_{at.microsecond // 1000:03d}"
        values = asdict(self.about)
        return parse_info(name, {**values, "tags": (*self.about.tags, TAG, rule.name)})

    def _stop(self, episode: _Open) -> None:
        self._open = None
        for watch in self._watches:
            self._rearmed_s[watch.rule.name] = self.now_s() + watch.rule.rearm_s
        if self.recorder.recording != episode.episode:
            return  # somebody stopped it
        try:
            answer = self.recorder.stop(reason=f"trigger {episode.rule.name}")
        except GstError as error:
            self.say(f"trigger {episode.rule.name}: {error}")
            return
        seconds = answer["duration_s"]
        self.say(f"{episode.episode}: {answer['messages']} messages, {seconds:.1f} s recorded")

    def close(self) -> None:
        """Stop watching; an episode that is open is left to the recorder."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)


def find_triggers(run: Path, path: Path | None) -> list[Rule]:
    """Return the rules of a recorder: those of a file, else of the run's ``triggers.toml``.

    Args:
        run: The run folder.
        path: What the user named, if anything.

    Raises:
        TriggerError: When they cannot be used.
    """
    if path is not None:
        return read_triggers(path)
    return read_triggers(run / TRIGGERS_FILE) if (run / TRIGGERS_FILE).is_file() else []
