"""Images on their way to the writer: one thread for each stream, so that order is kept.

The work is done outside Python's lock, and nothing else ever waits behind it. An image that
cannot be turned into what was asked for is recorded as it came, and flagged where it is broken.
"""

import traceback
from collections.abc import Callable
from dataclasses import replace
from queue import SimpleQueue
from threading import Thread

from bridge.episode import schema
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.images import (
    COLOR_LAYOUTS,
    DEPTH_ENCODINGS,
    ImageHeader,
    check_image,
    depth_to_compact,
    image_header,
    image_to_jpeg,
)
from bridge.episode.topics import COLOR_TOPIC, DEPTH_IMAGE
from bridge.record.config import RecorderConfig
from bridge.record.inspection import GOOD, MessageState
from bridge.record.queue import Item
from bridge.wire.session import WireSample

MAX_THREADS = 32
"""Streams beyond this many share the threads of others."""

Preview = Callable[[WireSample], None]
"""Called with the image as it came, on the stream's thread."""


def encode(item: Item, config: RecorderConfig) -> None:
    """Replace a raw image where the profile asks for it; flag what is broken."""
    sample = item.sample
    if item.type_name != schema.IMAGE or sample.message_encoding not in ("", "cdr"):
        return
    try:
        header = image_header(sample.data)
        check_image(sample.topic, header)
        item.finding, item.image_encoding = GOOD, header.encoding
        _transcode(item, header, config)
    except MalformedMessageError:
        item.finding = MessageState.UNDECODABLE


def _transcode(item: Item, header: ImageHeader, config: RecorderConfig) -> None:
    """Compress; depth in metres stays as it came, for RVL holds whole millimetres only."""
    sample, encoding, data = item.sample, header.encoding, None
    is_depth = encoding in DEPTH_ENCODINGS and not COLOR_TOPIC.search(sample.topic)
    if encoding in COLOR_LAYOUTS and config.color == "jpeg":
        data = image_to_jpeg(header, config.jpeg_quality)
    elif is_depth and config.depth == "compact":
        data = depth_to_compact(header)
    if data is not None:
        item.image_encoding, item.type_name = "", schema.COMPRESSED_IMAGE
        item.sample = replace(sample, data=data, type_name=item.type_name, type_hash="")


class EncoderThreads:
    """Hands each image to the thread of its stream."""

    def __init__(
        self, config: RecorderConfig, done: Callable[[Item, int], None], preview: Preview
    ) -> None:
        """Start without threads."""
        self._config = config
        self._done = done
        self._preview = preview
        self._queues: dict[str, SimpleQueue[Item | None]] = {}
        """By topic: what waits for its thread, in order."""
        self._threads: list[Thread] = []
        self.is_passing = False
        """Hand images on untouched: the disk has failed and only their count matters."""

    def submit(self, item: Item, is_watched: bool) -> bool:
        """Take an image that may change or is watched, then all of its topic; never waits.

        For one caller at a time.
        """
        topic = item.sample.topic
        if topic not in self._queues:
            if not (is_watched or self._may_change(item)):
                return False
            self._queues[topic] = self._queue_for(topic)
        self._queues[topic].put(item)
        return True

    def _may_change(self, item: Item) -> bool:
        is_jpeg = self._config.color == "jpeg" and not item.sample.topic.endswith(DEPTH_IMAGE)
        return item.type_name == schema.IMAGE and (is_jpeg or self._config.depth == "compact")

    def _queue_for(self, topic: str) -> "SimpleQueue[Item | None]":
        if len(self._threads) == MAX_THREADS:
            return list(self._queues.values())[len(self._queues) % MAX_THREADS]
        waiting: SimpleQueue[Item | None] = SimpleQueue()
        name = f"encode {topic}"[:60]
        self._threads.append(Thread(target=self._work, args=(waiting,), name=name, daemon=True))
        self._threads[-1].start()
        return waiting

    def _work(self, waiting: "SimpleQueue[Item | None]") -> None:
        while (item := waiting.get()) is not None:
            original = item.sample
            try:
                if not (self.is_passing or item.for_preview):
                    encode(item, self._config)
                if not self.is_passing:
                    self._preview(original)
            except Exception:  # noqa: BLE001  # a bug must not end the stream: record it as it is
                traceback.print_exc()
                item.finding = item.finding or MessageState.UNDECODABLE
            self._done(item, len(original.data) - len(item.sample.data))

    def close(self) -> None:
        """End the threads after what they hold."""
        for waiting in self._queues.values():
            waiting.put(None)
        for thread in self._threads:
            thread.join()
