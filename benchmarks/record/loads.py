"""Serialised messages of a few seconds in three mixes, for writers, readers and recovery.

Two cameras at 30 Hz, joints at 500 Hz, a gripper at 100 Hz. ``comp`` has JPEG and 16-bit PNG,
``mixed`` JPEG and raw noisy depth, ``raw`` raw colour and raw noisy depth.
"""

import io
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, DepthImage, JointSample
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.writer import EpisodeWriter, WriterConfig
from bridge.media.color import encode_jpeg
from record.frames import add_noise, native_frames

MIXES = ("comp", "mixed", "raw")
SECONDS = float(os.environ.get("RECORD_LOAD_SECONDS", "4"))
"""Also fewer, to try a benchmark; its numbers then go elsewhere."""
POOL = 15


class Load(NamedTuple):
    """One message to write."""

    topic: str
    type_name: str
    stamp_ns: int
    data: bytes


def load(mix: str) -> list[Load]:
    """Return the messages of a mix in time order."""
    rng = np.random.default_rng(0)
    colors, depths = native_frames(POOL)
    noisy = [add_noise(depth, rng) for depth in depths]
    pictures = [_color(mix, image) for image in colors]
    depth_data = [_depth(mix, image) for image in noisy]
    found = []
    for index in range(round(30 * SECONDS)):
        stamp_ns = index * 33_333_333
        for number, camera in enumerate(("side", "wrist")):
            at = (index + 7 * number) % POOL
            color_type = schema.IMAGE if mix == "raw" else schema.COMPRESSED_IMAGE
            depth_type = schema.COMPRESSED_IMAGE if mix == "comp" else schema.IMAGE
            prefix = f"/c/cam/{camera}"
            found.append(Load(f"{prefix}/color/image", color_type, stamp_ns, pictures[at]))
            found.append(Load(f"{prefix}/depth/image", depth_type, stamp_ns + 1, depth_data[at]))
    for topic, rate_hz, names in (
        ("/c/joint_states", 500, tuple("abcdef")),
        ("/c/gripper/state", 100, ("width",)),
    ):
        for index in range(round(rate_hz * SECONDS)):
            stamp_ns = index * 1_000_000_000 // rate_hz
            joints = JointSample(
                stamp_ns=stamp_ns,
                names=names,
                position=rng.normal(size=len(names)),
                velocity=rng.normal(size=len(names)),
                effort=np.zeros(len(names)),
            )
            found.append(Load(topic, schema.JOINT_STATE, stamp_ns, joints.to_cdr()))
    return sorted(found, key=lambda item: item.stamp_ns)


def _color(mix: str, image: np.ndarray) -> bytes:
    if mix == "raw":
        head = DepthImage(stamp_ns=0, frame_id="cam", depth_mm=np.zeros((1, 1), np.uint16))
        return head.to_cdr().replace(b"16UC1", b"bgr8\0") + image.tobytes()
    jpeg = encode_jpeg(image)
    return CompressedColor(stamp_ns=0, frame_id="cam", format="jpeg", data=jpeg).to_cdr()


def _depth(mix: str, depth_mm: np.ndarray) -> bytes:
    if mix != "comp":
        return DepthImage(stamp_ns=0, frame_id="cam", depth_mm=depth_mm).to_cdr()
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(depth_mm).save(stream, "png", compress_level=1)
    png = stream.getvalue()
    return CompressedColor(stamp_ns=0, frame_id="cam", format="png", data=png).to_cdr()


def megabytes(messages: list[Load]) -> float:
    """Payload of a load [MB]."""
    return sum(len(item.data) for item in messages) / 1e6


def write_ours(path: Path, messages: list[Load], config: WriterConfig) -> Path:
    """Write a load with our writer, its clock being the messages'."""
    path.unlink(missing_ok=True)
    now_s = 0.0
    with EpisodeWriter(path, config=config, monotonic=lambda: now_s) as writer:
        writer.describe(EpisodeInfo(id="bench", kind="trial"))
        for topic, name, stamp_ns, data in messages:
            writer.write(topic, data, type_name=name, log_time_ns=stamp_ns)
            if config.flush_s is not None:
                now_s = stamp_ns * 1e-9
                writer.tick()
    return path


def write_official(path: Path, messages: list[Load], compression: str) -> Path:
    """Write a load with the ``mcap`` package's writer, everything in the same 1 MiB chunks."""
    from mcap.writer import CompressionType, Writer

    with io.FileIO(str(path), "w") as stream:
        writer = Writer(stream, compression=CompressionType[compression])
        writer.start(profile="ros2")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, name, stamp_ns, data in messages:
            if topic not in channels:
                if name not in schemas:
                    known = schema.schema_for(name)
                    schemas[name] = writer.register_schema(name, known.schema_encoding, known.data)
                channels[topic] = writer.register_channel(topic, "cdr", schemas[name])
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns)
        writer.finish()
        writer.flush()
    return path
