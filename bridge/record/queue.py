"""The queues between the network threads and the writer: bounded, ordered, honest.

Two budgets in bytes: one for images and other bulk, one for everything else, so that images can
never evict joints. A message that is not taken in is counted, and the count itself is queued, so
that it is booked in the episode and the second it belongs to. Commands are never dropped and keep
their place among the messages.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.messages import transforms_from_cdr
from bridge.episode.topics import OF_RECORDER, TF_STATIC, is_latched
from bridge.episode.writer import LARGE_BYTES
from bridge.record.config import BYTES_PER_MB, QueueConfig
from bridge.record.inspection import MessageState, resolve_type
from bridge.record.sequence import SequenceTracker, Step
from bridge.wire.clocks import Sent
from bridge.wire.session import WireSample

MAX_LATCHED = 1000
MAX_LATCHED_BYTES = 256_000_000
"""Maps are large; a file that begins with more than this of the past is refused the rest."""
MAX_DECLARED = 1000
NOT_LATCHED = frozenset(("/rosout",))
"""Transient local in ROS 2, yet what was logged once does not stay true."""


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

    def forget(self, prefix: str, but: tuple[str, ...] = ()) -> None:
        """Drop the messages of topics that begin so: their publisher has gone."""
        gone = [key for key in self._kept if key[0].startswith(prefix)]
        self._drop([key for key in gone if not key[0].startswith(but)])

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
    except (codec.MalformedMessageError, ValueError):
        return frozenset()


MAX_WARNINGS = 1000


@dataclass(slots=True)
class Item:
    """A message that was taken in; the encoder of its stream may put a smaller one in its place."""

    sample: WireSample
    step: Step
    ticket: int
    type_name: str
    """Of what is written; "" when nobody knows."""
    size: int
    """Bytes as they came over the wire."""
    is_bulk: bool
    """Takes space from the budget of images, not from that of small messages."""
    finding: MessageState | None = None
    """None when nobody has looked yet."""
    for_preview: bool = False
    """Nobody records; only a preview is made of it."""
    image_encoding: str = ""
    """Of a raw image, for example 16UC1: another one is written to a channel of its own."""

    @property
    def received_ns(self) -> int:
        """When it arrived, by the recorder's clock."""
        return self.sample.received_ns


@dataclass(kw_only=True, slots=True)
class DropCount:
    """What was not taken in of one topic in one second."""

    messages: int = 0
    gaps: int = 0
    fills: list[int] = field(default_factory=list)
    """Tickets at which messages that then came late had been booked as missing."""


@dataclass(kw_only=True, slots=True)
class Dropped:
    """Messages not taken in between two entries."""

    ticket: int
    received_ns: int
    counts: dict[tuple[str, int], DropCount] = field(default_factory=dict)
    """By (topic, second of reception)."""
    warnings: dict[str, None] = field(default_factory=dict)
    told: set[tuple[str, bytes]] = field(default_factory=set)
    """Publishers that said how many messages they had sent; what is missing is counted."""

    def count(self, topic: str, received_ns: int) -> DropCount:
        """Where to count what was not taken in at this instant."""
        return self.counts.setdefault((topic, second_of(received_ns)), DropCount())

    def warn(self, text: str) -> None:
        """Remember a remark, once."""
        if text not in self.warnings and len(self.warnings) < MAX_WARNINGS:
            self.warnings[text] = None


@dataclass(kw_only=True, slots=True)
class Command:
    """Something to do at this place in the stream."""

    action: Callable[["Command"], None]
    received_ns: int
    is_barrier: bool = True
    """Waits until every image received before it went through its encoder."""
    ticket: int = 0
    images_before: int = 0
    number: int = 0


Entry = Item | Dropped | Command
"""What the writer thread takes, in order."""


def second_of(stamp_ns: int) -> int:
    """The whole second a stamp lies in."""
    return stamp_ns // NS_PER_S


BULK_BYTES = LARGE_BYTES
"""A topic with a message of this size counts as bulk from then on, whatever its type."""
OVERHEAD_BYTES = 512
"""What a queued message costs beside its data, roughly."""
IMAGE_TYPES = frozenset((schema.IMAGE, schema.COMPRESSED_IMAGE))


@dataclass(slots=True)
class Flow:
    """What is known of one topic (with one type) since the recorder began."""

    topic: str
    type_name: str
    is_image: bool
    is_ledger: bool
    """A topic of which only a recorder speaks; nobody else may."""
    is_bulk: bool
    """Takes space from the budget of images, and waits for the disk with them; also video, which
    goes past the encoders."""
    seen: int = 0
    second: int = 0
    in_second: int = 0


class InputQueue:
    """Filled by network threads, emptied by the writer thread."""

    def __init__(self, limits: QueueConfig, hand_over: Callable[[Item, bool], bool]) -> None:
        """Set the budgets; ``hand_over`` is told whether an image is watched, and may take it."""
        self._limits = limits
        self._bulk_budget = limits.camera_queue_mb * BYTES_PER_MB
        self._small_budget = limits.small_queue_mb * BYTES_PER_MB
        self._max_bytes = limits.max_message_bytes
        self._hand_over = hand_over
        self._tracker = SequenceTracker()
        self.latched = LatchedTopics()
        """Queued even while nothing is recorded."""
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._entries: deque[Entry] = deque()
        self._images: deque[Item] = deque()
        self._dropped: Dropped | None = None
        self._flows: dict[tuple[str, str], Flow] = {}
        self._ticket = 0
        self.images_in = 0
        """Images and other bulk taken in so far."""
        self._commands = 0
        self._bulk_bytes = 0
        self._small_in = 0
        self._small_out = 0
        self._is_quiet = False
        self.watched: frozenset[str] = frozenset()
        """Image topics of which somebody wants a preview."""

    @property
    def queued_bytes(self) -> int:
        """What waits, images and small messages together."""
        return self._bulk_bytes + self._small_in - self._small_out

    def seen(self) -> dict[str, int]:
        """Messages of each topic since the recorder began, recorded or not."""
        counts: dict[str, int] = {}
        for flow in list(self._flows.values()):
            counts[flow.topic] = counts.get(flow.topic, 0) + flow.seen
        return dict(sorted(counts.items()))

    def image_topics(self) -> list[str]:
        """Topics that carry images, in the order they were first seen."""
        return [flow.topic for flow in list(self._flows.values()) if flow.is_image]

    def put(self, sample: WireSample) -> None:
        """Take a message; never waits, never raises."""
        with self._lock:
            ticket = self._ticket
            self._ticket = ticket + 1
            step = self._tracker.observe(sample, ticket)
            flow = self._flows.get((sample.topic, sample.type_name)) or self._new_flow(sample)
            flow.seen += 1
            for_preview = False
            if self._is_quiet and sample.topic not in self.latched:
                for_preview = flow.is_image and sample.topic in self.watched
                if not for_preview:
                    return
            size = len(sample.data)
            is_bulk = flow.is_bulk = flow.is_bulk or size >= BULK_BYTES
            cost = size + OVERHEAD_BYTES
            if not self._fits(flow, sample, step, cost=cost, is_bulk=is_bulk):
                return
            item = Item(sample, step, ticket, flow.type_name, size, is_bulk)
            if is_bulk:
                self._bulk_bytes += cost
                self.images_in += 1
            else:
                self._small_in += cost
            item.for_preview = for_preview
            if not (flow.is_image and self._hand_over(item, sample.topic in self.watched)):
                self._entries.append(item)

    def _new_flow(self, sample: WireSample) -> Flow:
        if len(self._flows) >= self._limits.max_topics:
            del self._flows[next(iter(self._flows))]
        type_name = resolve_type(sample.topic, sample.type_name)
        topic = sample.topic
        flow = Flow(
            topic,
            type_name,
            is_image=type_name in IMAGE_TYPES,
            is_bulk=type_name in IMAGE_TYPES or type_name == schema.COMPRESSED_VIDEO,
            is_ledger=topic in OF_RECORDER,
        )
        self._flows[sample.topic, sample.type_name] = flow
        return flow

    def _fits(
        self, flow: Flow, sample: WireSample, step: Step, *, cost: int, is_bulk: bool
    ) -> bool:
        """Say whether a message may be taken in; count it if not."""
        second = second_of(sample.received_ns)
        if second != flow.second:
            flow.second, flow.in_second = second, 0
        flow.in_second += 1
        small = self._small_budget - (self._small_in - self._small_out)
        free = self._bulk_budget - self._bulk_bytes if is_bulk else small
        if flow.in_second > self._limits.max_rate_hz:
            self._drop(sample, step, f"over {self._limits.max_rate_hz} messages a second")
        elif sample.oversize_bytes or cost - OVERHEAD_BYTES > self._max_bytes:
            self._drop(sample, step, f"messages over {self._limits.max_message_mb:g} MB")
        elif flow.is_ledger:
            self._drop(sample, step, "messages of anybody but the recorder")
        elif cost > free:
            self._drop(sample, step, "")
        else:
            return True
        return False

    def _drop(self, sample: WireSample, step: Step, limit: str) -> None:
        """Count a message that is left out, for want of space where it broke no limit."""
        dropped = self._open_drops(sample.received_ns)
        count = dropped.count(sample.topic, sample.received_ns)
        count.gaps += step.gap
        if step.fills is not None:
            count.fills.append(step.fills)
        if step.repeated:
            return
        count.messages += 1
        if limit:
            dropped.warn(f"{sample.topic}: {limit} are dropped")

    def _open_drops(self, now_ns: int) -> Dropped:
        if self._dropped is None:
            self._dropped = Dropped(ticket=self._ticket - 1, received_ns=now_ns)
            self._entries.append(self._dropped)
        return self._dropped

    def told(self, sent: Sent, now_ns: int) -> None:
        """Take what publishers say they have sent by now: what of it has not come is lost."""
        with self._lock:
            self._ticket += 1
            for (topic, gid), count in sent.items():
                gap = self._tracker.told(topic, gid, count, self._ticket - 1)
                if gap is not None and not self._is_quiet:
                    dropped = self._open_drops(now_ns)
                    dropped.told.add((topic, gid))
                    if gap:
                        dropped.count(topic, now_ns).gaps += gap

    def put_image(self, item: Item, saved: int) -> None:
        """Take an image back from its encoder."""
        if saved:
            with self._lock:
                self._bulk_bytes -= saved
        self._images.append(item)

    def put_command(self, command: Command) -> None:
        """Queue a command behind everything received so far."""
        with self._lock:
            command.ticket = self._ticket
            self._ticket += 1
            command.images_before = self.images_in
            self._dropped = None
            self._is_quiet = False
            self._commands += 1
            command.number = self._commands
            self._entries.append(command)
        self._wake.set()

    def wait(self, timeout_s: float) -> None:
        """Wait for a command, at most so long."""
        if self._wake.wait(timeout_s):
            self._wake.clear()

    def take(self) -> tuple[deque[Entry], list[Item]]:
        """Return what has come in since the last call: in order of arrival, and encoded images."""
        images = []  # first: a command that came before one of these is then among the entries
        while self._images:
            images.append(self._images.popleft())
        with self._lock:
            entries, self._entries = self._entries, deque()
            self._dropped = None
        return entries, images

    def release(self, item: Item) -> None:
        """Give back the space of a message that was dealt with; called by the writer thread."""
        cost = len(item.sample.data) + OVERHEAD_BYTES
        if item.is_bulk:
            with self._lock:
                self._bulk_bytes -= cost
        else:
            self._small_out += cost

    def be_quiet(self, after: int) -> None:
        """Only note what is latched from now on, unless a command came after this one."""
        with self._lock:
            self._is_quiet = self._commands == after


# Small messages never wait for images; images wait while the disk is behind. A barrier command
# (start, stop ...) waits until every image received before it has come out of its encoder, and
# holds back everything received after it.


class Merge:
    """Fed with what the input_queue gives; yields what may be dealt with now."""

    def __init__(self, may_write_bulk: Callable[[], bool] = lambda: True) -> None:
        """Start empty; ``may_write_bulk`` says whether the disk keeps up with images."""
        self._may_write_bulk = may_write_bulk
        self._entries: deque[Entry] = deque()
        self._held: deque[Item] = deque()
        self.images_out = 0
        """Images yielded or given up."""

    @property
    def images_seen(self) -> int:
        """Images that have come out of their encoders."""
        return self.images_out + len(self._held)

    @property
    def is_waiting(self) -> bool:
        """Say whether a command waits for images."""
        return bool(self._entries)

    def feed(self, entries: Iterable[Entry], images: Iterable[Item]) -> None:
        """Add what came in; bulk that needs no encoder is held with the images."""
        for entry in entries:
            is_bulk = isinstance(entry, Item) and entry.is_bulk
            (self._held if is_bulk else self._entries).append(entry)  # type: ignore[arg-type]
        self._held.extend(images)

    def ready(self) -> Iterator[Entry]:
        """Yield, in order, all that need not wait; what is yielded is forgotten."""
        while True:
            while self._entries and not _is_barrier(self._entries[0]):
                yield self._entries.popleft()
            barrier = self._entries[0] if self._entries else None
            if not isinstance(barrier, Command):
                yield from self._images_before(None, self._may_write_bulk)
                return
            yield from self._images_before(barrier.ticket, self._may_write_bulk)
            if self.images_out < barrier.images_before:
                return
            yield self._entries.popleft()

    def _images_before(
        self, ticket: int | None, may_go_on: Callable[[], bool] = lambda: True
    ) -> Iterator[Item]:
        # One by one: what has not been yielded must be found by rest(), called in between.
        at = 0
        while at < len(self._held) and may_go_on():
            item = self._held[at]
            if ticket is None or item.ticket < ticket:
                del self._held[at]
                self.images_out += 1
                yield item
            else:
                at += 1

    def rest(self) -> list[Item | Dropped]:
        """Give up what has not been yielded, up to the next barrier; commands stay."""
        barrier = next((entry for entry in self._entries if _is_barrier(entry)), None)
        ticket = barrier.ticket if isinstance(barrier, Command) else None
        given_up: list[Item | Dropped] = list(self._images_before(ticket))
        kept: deque[Entry] = deque()
        for entry in self._entries:
            is_late = (
                ticket is not None and not isinstance(entry, Command) and entry.ticket > ticket
            )
            if isinstance(entry, Command) or is_late:
                kept.append(entry)
            else:
                given_up.append(entry)
        self._entries = kept
        return given_up


def _is_barrier(entry: Entry) -> bool:
    return isinstance(entry, Command) and entry.is_barrier
