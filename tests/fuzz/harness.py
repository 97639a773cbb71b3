"""Feed bytes made by libFuzzer to everything that reads bytes of unknown origin.

Run it for long by hand: ``TMPDIR=/dev/shm python tests/fuzz/harness.py read CORPUS
-max_total_time=3600``; the corpus folder is made and seeded where needed. Whatever is raised
beyond ``GstError``, a hang (``-timeout``) and memory beyond ``LIMIT_BYTES`` end the run with the
input kept in ``crash-*``.
"""

import contextlib
import io
import os
import resource
import sys
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import atheris
import numpy as np

with atheris.instrument_imports(include=["bridge"]):
    from mcap.writer import CompressionType, Writer

    from bridge.episode import schema
    from bridge.episode.cdr import codec
    from bridge.episode.check import check_episode
    from bridge.episode.mcap.format import crc32
    from bridge.episode.reader import Episode
    from bridge.episode.recover import recover
    from bridge.episode.schema import ROS_TYPES
    from bridge.errors import GstError
    from bridge.media.depth import decode_rvl, encode_rvl
    from bridge.wire import publisher

LIMIT_BYTES = 3 << 30
TYPES = sorted(ROS_TYPES)
FOLDER = Path(tempfile.gettempdir()) / f"gst-fuzz-{os.getpid()}"
"""Left behind, for libFuzzer ends the process where it stands; set TMPDIR to choose its place."""


def read_target(data: bytes) -> None:
    """Open and read an episode; a file without faults must be readable to its end."""
    path = FOLDER / "x.mcap"
    path.write_bytes(data)
    count = None
    with contextlib.suppress(GstError):
        episode = Episode.open(path)
        episode.topics()
        with contextlib.suppress(GstError):
            _ = episode.info, episode.outcome, episode.derived, episode.duration_s
        count = sum(1 for _ in episode.messages())
        episode.attachment("a")
    report = check_episode(path)
    if not report.faults and count != report.messages:
        message = f"clean, but {count} messages instead of {report.messages}"
        raise AssertionError(message)


def recover_target(data: bytes) -> None:
    """Recover a part; what comes out must be whole."""
    for old in FOLDER.iterdir():
        old.unlink()
    path = FOLDER / "x.mcap.part"
    path.write_bytes(data)
    with contextlib.suppress(GstError):
        report = recover(path)
        if report.output is not None:
            found = sum(1 for _ in Episode.open(report.output).messages())
            if found != report.messages:
                message = f"{report.messages} messages recovered, {found} read"
                raise AssertionError(message)


def cdr_target(data: bytes) -> None:
    """Decode a message of some type; what does not fit is one error."""
    if not data:
        return
    with contextlib.suppress(codec.MalformedMessageError):
        codec.decode(TYPES[data[0] % len(TYPES)], data[1:])


def attachment_target(data: bytes) -> None:
    """Read the attachment of a message."""
    found = publisher.decode(data)
    if found is not None and len(data) == 33 and publisher.encode(found) != data:
        message = f"{data.hex()} changed on the way"
        raise AssertionError(message)


def depth_target(data: bytes) -> None:
    """Decode a depth stream that claims some pixels, and pack the bytes as pixels and back."""
    claimed, stream = int.from_bytes(data[:2], "little"), data[2:]
    with contextlib.suppress(ValueError):
        decode_rvl(stream, claimed)
    pixels = np.frombuffer(stream[: len(stream) // 2 * 2], dtype="<u2")
    if pixels.size and not np.array_equal(
        decode_rvl(encode_rvl(pixels.reshape(1, -1)), pixels.size), pixels
    ):
        message = f"{pixels.tobytes().hex()} changed on the way"
        raise AssertionError(message)


def checksum_target(data: bytes) -> None:
    """Sum the bytes at once and in two pieces, beginning at any address."""
    cut = data[0] if data else 0
    pieces = crc32(memoryview(data)[cut:], crc32(memoryview(data)[:cut], 0))
    if not crc32(data, 0) == pieces == zlib.crc32(data):
        message = f"{data.hex()} has another checksum"
        raise AssertionError(message)


TARGETS: dict[str, Callable[[bytes], None]] = {
    "read": read_target,
    "recover": recover_target,
    "cdr": cdr_target,
    "attachment": attachment_target,
    "depth": depth_target,
    "checksum": checksum_target,
}


def mcap_seeds() -> list[bytes]:
    """Small files without CRCs, which would reject nearly every change."""
    seeds = []
    for compression in CompressionType:
        for use_chunking in (True, False):
            stream = io.BytesIO()
            writer = Writer(
                stream,
                chunk_size=100,
                compression=compression,
                enable_crcs=False,
                use_chunking=use_chunking,
            )
            writer.start(profile="ros2", library="robot-gst")
            known = schema.schema_for(schema.STRING)
            text = known.data if known else b""
            schema_id = writer.register_schema(schema.STRING, "ros2msg", text)
            channel = writer.register_channel("/robot_description", "cdr", schema_id)
            for n in range(4):
                data = codec.encode(schema.STRING, {"data": "text"})
                writer.add_message(channel, n, data, n, sequence=n)
            writer.add_attachment(1, 1, "a", "text/plain", b"attached")
            writer.add_metadata("episode", {"id": '"x"', "kind": '"trial"'})
            writer.finish()
            seeds += [stream.getvalue(), stream.getvalue()[: len(stream.getvalue()) // 2]]
    return seeds


def seed(target: str, corpus: Path) -> None:
    """Make the corpus folder with inputs to begin from."""
    corpus.mkdir(parents=True, exist_ok=True)
    if target in ("read", "recover"):
        seeds = mcap_seeds()
    elif target == "cdr":
        seeds = [bytes([n]) + codec.encode(name, {}) for n, name in enumerate(TYPES)]
    elif target == "depth":
        streams = [encode_rvl(np.full((4, 8), value, dtype="<u2")) for value in (0, 7, 65535)]
        seeds = [(32).to_bytes(2, "little") + stream for stream in streams]
    elif target == "checksum":
        seeds = [bytes(range(size)) for size in (1, 63, 64, 200)]
    else:
        one = publisher.Attachment(sequence=1, source_ns=2, gid=bytes(16))
        seeds = [publisher.encode(one), bytes(77)]
    for number, data in enumerate(seeds):
        (corpus / f"seed-{number}").write_bytes(data)


def main() -> None:
    """Fuzz one target: name, corpus folder, libFuzzer's own options."""
    name, corpus, *options = sys.argv[1:]
    if "libasan" not in os.environ.get("LD_PRELOAD", ""):  # which reserves terabytes, unused
        resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    seed(name, Path(corpus))
    FOLDER.mkdir(parents=True)
    atheris.Setup([sys.argv[0], corpus, *options], TARGETS[name])
    atheris.Fuzz()


if __name__ == "__main__":
    main()
