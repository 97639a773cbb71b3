"""The reference recorder: zenoh to the official ``mcap`` Writer, zstd, as most people write it.

Colour becomes JPEG (quality 90), depth 16-bit PNG by OpenCV at its quickest level, each camera
stream on its own thread behind a bounded queue that makes the publisher wait; everything else is
written as it comes.
"""

import queue
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from mcap.writer import CompressionType, Writer

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from bridge.episode import schema  # noqa: E402
from bridge.episode.cdr import codec  # noqa: E402
from bridge.wire.config import WireConfig  # noqa: E402
from bridge.wire.session import WireSample, open_session  # noqa: E402

QUEUED_FRAMES = 32
QUIET_S = 0.5


class Reference:
    """Encodes and writes."""

    def __init__(self, path: Path) -> None:
        """Start the file."""
        self.stream = path.open("wb")
        self.writer = Writer(self.stream, compression=CompressionType.ZSTD)
        self.writer.start(profile="ros2")
        self.lock = threading.Lock()
        self.channels: dict[str, int] = {}
        self.queues: dict[str, queue.Queue[WireSample | None]] = {}
        self.threads: list[threading.Thread] = []

    def take(self, sample: WireSample) -> None:
        """On the network thread: images wait for their encoder, the rest is written."""
        if sample.type_name != schema.IMAGE:
            self.write(sample, sample.type_name, sample.data)
            return
        if sample.topic not in self.queues:
            self.queues[sample.topic] = queue.Queue(QUEUED_FRAMES)
            thread = threading.Thread(target=self.encode, args=(self.queues[sample.topic],))
            self.threads.append(thread)
            thread.start()
        self.queues[sample.topic].put(sample)

    def encode(self, waiting: "queue.Queue[WireSample | None]") -> None:
        """Compress the images of one stream until None comes."""
        while (sample := waiting.get()) is not None:
            image = codec.decode(schema.IMAGE, sample.data)
            shape = (image["height"], image["width"])
            if image["encoding"] == "rgb8":
                pixels = np.frombuffer(image["data"], np.uint8).reshape(*shape, 3)
                kind, data = "jpeg", simplejpeg.encode_jpeg(pixels, quality=90)
            else:
                pixels = np.frombuffer(image["data"], np.uint16).reshape(shape)
                level = [cv2.IMWRITE_PNG_COMPRESSION, 1]
                kind, data = "png", cv2.imencode(".png", pixels, level)[1].tobytes()
            message = {"header": image["header"], "format": kind, "data": data}
            encoded = codec.encode(schema.COMPRESSED_IMAGE, message)
            self.write(sample, schema.COMPRESSED_IMAGE, encoded)

    def write(self, sample: WireSample, type_name: str, data: bytes) -> None:
        """Append a message."""
        with self.lock:
            if sample.topic not in self.channels:
                known = schema.schema_for(type_name)
                schema_id = self.writer.register_schema(
                    type_name, known.schema_encoding, known.data
                )
                channel_id = self.writer.register_channel(sample.topic, "cdr", schema_id)
                self.channels[sample.topic] = channel_id
            self.writer.add_message(
                self.channels[sample.topic],
                sample.received_ns,
                data,
                sample.source_ns,
                sample.sequence,
            )

    def finish(self) -> None:
        """Encode what waits, then end the file."""
        for waiting in self.queues.values():
            waiting.put(None)
        for thread in self.threads:
            thread.join()
        self.writer.finish()
        self.stream.close()


def main() -> None:
    """Record from the start until standard input says so."""
    endpoint, path = sys.argv[1], Path(sys.argv[2])
    reference = Reference(path)
    with open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as session:
        subscriber = session.subscribe("bench/**", reference.take)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.readline()
        subscriber.close()
        reference.finish()
        sys.stdout.write("finished\n")
        sys.stdout.flush()
        sys.stdin.readline()


if __name__ == "__main__":
    main()
