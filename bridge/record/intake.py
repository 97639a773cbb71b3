"""The queues between the network threads and the writer: bounded, ordered, honest.

Two budgets in bytes: one for images and other bulk, one for everything else, so that images can
never evict joints. A message that is not taken in is counted, and the count itself is queued, so
that it is booked in the episode and the second it belongs to. Commands are never dropped and keep
their place among the messages.
"""

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from bridge.episode import schema
from bridge.record.config import BYTES_PER_MB, QueueConfig
from bridge.record.entries import Command, DropCount, Dropped, Entry, Item, second_of
from bridge.record.inspection import resolve_type
from bridge.record.latched import LatchedTopics
from bridge.record.sequence import SequenceTracker, Step
from bridge.record.shedding import Shed, keep_every, next_level
from bridge.wire.session import WireSample

BULK_BYTES = 1_000_000
"""A message of this size counts as bulk whatever its type."""
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
    """The topic on which a recorder says what it lost; nobody else may."""
    seen: int = 0
    second: int = 0
    in_second: int = 0
    waiting: int = 0
    """Images since the last one that was kept while shedding."""


class Intake:
    """Filled by network threads, emptied by the writer thread."""

    def __init__(
        self, limits: QueueConfig, hand_over: Callable[[Item], None], kinds: Mapping[str, str]
    ) -> None:
        """Set the budgets.

        Args:
            limits: Budgets and limits.
            hand_over: Called with each image; it comes back through ``put_image``.
            kinds: color or depth, for each image topic whose encoder knows.
        """
        self._limits = limits
        self._bulk_budget = limits.camera_queue_mb * BYTES_PER_MB
        self._small_budget = limits.small_queue_mb * BYTES_PER_MB
        self._max_bytes = limits.max_message_bytes
        self._hand_over = hand_over
        self._kinds = kinds
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
        """Images handed over so far."""
        self._commands = 0
        self._bulk_bytes = 0
        self._small_in = 0
        self._small_out = 0
        self._is_quiet = False
        self.shed = Shed.NOTHING
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
            is_bulk = flow.is_image or size >= BULK_BYTES
            cost = size + OVERHEAD_BYTES
            if not self._has_room(flow, sample, step, cost=cost, is_bulk=is_bulk):
                return
            item = Item(sample, step, ticket, flow.type_name, size, is_bulk)
            if is_bulk:
                self._bulk_bytes += cost
            else:
                self._small_in += cost
            if flow.is_image:
                item.for_preview = for_preview
                self.images_in += 1
                self._hand_over(item)
            else:
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
            is_ledger=topic == schema.DROPS_TOPIC,
        )
        self._flows[sample.topic, sample.type_name] = flow
        return flow

    def _has_room(
        self, flow: Flow, sample: WireSample, step: Step, *, cost: int, is_bulk: bool
    ) -> bool:
        """Say whether a message may be taken in; count it if not."""
        second = second_of(sample.received_ns)
        if second != flow.second:
            flow.second, flow.in_second = second, 0
        flow.in_second += 1
        if flow.in_second > self._limits.max_rate_hz:
            self._drop(sample, step, f"over {self._limits.max_rate_hz} messages a second")
        elif sample.oversize_bytes or cost - OVERHEAD_BYTES > self._max_bytes:
            self._drop(sample, step, f"messages over {self._limits.max_message_mb:g} MB")
        elif flow.is_ledger:
            self._drop(sample, step, "messages of anybody but the recorder")
        elif is_bulk and self._is_shed(flow):
            self._drop(sample, step, None)
        elif cost > self._room(is_bulk=is_bulk):
            self._drop(sample, step, "")
        else:
            return True
        return False

    def _room(self, *, is_bulk: bool) -> int:
        if is_bulk:
            return self._bulk_budget - self._bulk_bytes
        return self._small_budget - (self._small_in - self._small_out)

    def _is_shed(self, flow: Flow) -> bool:
        self.shed = next_level(self.shed, self._bulk_bytes / self._bulk_budget)
        every = keep_every(self.shed, self._kinds.get(flow.topic, ""))
        flow.waiting += 1
        if flow.waiting < every:
            return True
        flow.waiting = 0
        return False

    def _drop(self, sample: WireSample, step: Step, limit: str | None) -> None:
        """Count a message that is left out.

        Args:
            sample: The message.
            step: Its place in its stream.
            limit: The limit it broke, "" for want of room, None for shedding.
        """
        if self._dropped is None:
            self._dropped = Dropped(ticket=self._ticket - 1, received_ns=sample.received_ns)
            self._entries.append(self._dropped)
        key = (sample.topic, second_of(sample.received_ns))
        count = self._dropped.counts.get(key)
        if count is None:
            count = self._dropped.counts[key] = DropCount()
        count.gaps += step.gap
        if step.fills is not None:
            count.fills.append(step.fills)
        if step.repeated:
            return
        if limit is None:
            count.shed += 1
        else:
            count.messages += 1
        if limit:
            self._dropped.warn(f"{sample.topic}: {limit} are dropped")

    def put_image(self, item: Item, saved: int) -> None:
        """Take an image back from its encoder.

        Args:
            item: As it is to be written.
            saved: Bytes it has become smaller.
        """
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
        """Give back the room of a message that was dealt with; called by the writer thread."""
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
