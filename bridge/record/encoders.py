"""Images on their way to the writer: one thread for each stream, so that order is kept.

The work is done outside Python's lock, and nothing else ever waits behind it. An image that
cannot be turned into what was asked for is recorded as it came, and flagged where it is broken.
"""

import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from bridge.episode import schema
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.images import (
    COLOR_LAYOUTS,
    DEPTH_ENCODINGS,
    check_image,
    depth_to_compact,
    image_header,
    image_to_jpeg,
)
from bridge.episode.topics import COLOR_TOPIC
from bridge.record.config import RecorderConfig
from bridge.record.inspection import GOOD, MessageState, inspector
from bridge.record.queue import Item
from bridge.wire.session import WireSample

MAX_THREADS = 32
"""Streams beyond this many share the threads of others."""

Preview = Callable[[WireSample], None]
"""Called with the image as it came, on the stream's thread."""


def encode(item: Item, config: RecorderConfig) -> None:
    """Replace an item's message where the profile asks for it; flag what is broken."""
    sample = item.sample
    if item.type_name != schema.IMAGE or sample.message_encoding not in ("", "cdr"):
        item.finding = inspector(item.type_name, sample.message_encoding)(sample.data)
        return
    try:
        header = image_header(sample.data)
        check_image(sample.topic, header)
        item.finding, item.image_encoding = GOOD, header.encoding
        _transcode(item, header.encoding, config)
    except MalformedMessageError:
        item.finding = MessageState.UNDECODABLE


def _transcode(item: Item, encoding: str, config: RecorderConfig) -> None:
    """Compress; depth in metres stays as it came, for RVL holds whole millimetres only."""
    sample, data = item.sample, None
    is_depth = encoding in DEPTH_ENCODINGS and not COLOR_TOPIC.search(sample.topic)
    if encoding in COLOR_LAYOUTS and config.color == "jpeg":
        data = image_to_jpeg(sample.data, config.jpeg_quality)
    elif is_depth and config.depth == "compact":
        data = depth_to_compact(sample.data)
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
        self._threads: dict[str, ThreadPoolExecutor] = {}
        """By topic: a pool of one thread, which keeps the order."""
        self.is_passing = False
        """Hand images on untouched: the disk has failed and only their count matters."""

    def submit(self, item: Item) -> None:
        """Queue an image; never waits. For one caller at a time."""
        topic = item.sample.topic
        thread = self._threads.get(topic)
        if thread is None:
            others = list(dict.fromkeys(self._threads.values()))
            if len(others) < MAX_THREADS:
                thread = ThreadPoolExecutor(1, thread_name_prefix=f"encode {topic}"[:60])
            else:
                thread = others[len(self._threads) % MAX_THREADS]
            self._threads[topic] = thread
        thread.submit(self._work, item)

    def _work(self, item: Item) -> None:
        before = len(item.sample.data)
        try:
            if not self.is_passing:
                self._treat(item)
        except Exception:  # noqa: BLE001  # a bug must not end the stream: record it as it is
            traceback.print_exc()
            item.finding = item.finding or MessageState.UNDECODABLE
        self._done(item, before - len(item.sample.data))

    def _treat(self, item: Item) -> None:
        original = item.sample
        if not item.for_preview:
            encode(item, self._config)
        self._preview(original)

    def close(self) -> None:
        """End the threads after what they hold."""
        for thread in set(self._threads.values()):
            thread.shutdown()
        self._threads.clear()
