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
    FLOAT_DEPTH,
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

Preview = Callable[[WireSample, str], None]
"""Called with the image as it came and its kind, on the stream's thread."""


class ImageEncoder:
    """Turns raw images into what an episode holds."""

    def __init__(self, config: RecorderConfig) -> None:
        """Choose the profile."""
        self._config = config
        self.kinds: dict[str, str] = {}
        """color or depth, for each image topic seen."""

    def encode(self, item: Item) -> None:
        """Replace the item's message where the profile asks for it; flag what is broken."""
        sample = item.sample
        if item.type_name != schema.IMAGE or sample.message_encoding not in ("", "cdr"):
            item.finding = inspector(item.type_name, sample.message_encoding)(sample.data)
            if sample.topic not in self.kinds:
                is_depth = b"compressedDepth" in sample.data[:256]
                self.kinds[sample.topic] = "depth" if is_depth else "color"
            return
        try:
            header = image_header(sample.data)
            check_image(sample.topic, header)
            item.finding, item.image_encoding = GOOD, header.encoding
            self._transcode(item, header.encoding)
        except MalformedMessageError:
            item.finding = MessageState.UNDECODABLE

    def _transcode(self, item: Item, encoding: str) -> None:
        data, topic = None, item.sample.topic
        if encoding in COLOR_LAYOUTS:
            self.kinds[topic] = "color"
            if self._config.color == "jpeg":
                data = image_to_jpeg(item.sample.data, self._config.jpeg_quality)
        elif encoding in DEPTH_ENCODINGS and not COLOR_TOPIC.search(topic):
            self.kinds[topic] = "depth"
            if self._config.depth == "compact":
                data = depth_to_compact(item.sample.data)
        elif encoding == FLOAT_DEPTH:  # recorded as it came: RVL holds whole millimetres only
            self.kinds[topic] = "depth"
        if data is not None:
            item.image_encoding = ""
            item.sample = replace(
                item.sample, data=data, type_name=schema.COMPRESSED_IMAGE, type_hash=""
            )
            item.type_name = schema.COMPRESSED_IMAGE


class EncoderThreads:
    """Hands each image to the thread of its stream."""

    def __init__(
        self, encoder: ImageEncoder, done: Callable[[Item, int], None], preview: Preview
    ) -> None:
        """Start without threads."""
        self._encoder = encoder
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
            self._encoder.encode(item)
        self._preview(original, self._encoder.kinds.get(original.topic, ""))

    def close(self) -> None:
        """End the threads after what they hold."""
        for thread in set(self._threads.values()):
            thread.shutdown()
        self._threads.clear()
