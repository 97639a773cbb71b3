"""Write at a live rate until killed, telling the parent what was written; or recover in a loop."""

import sys
import time
from pathlib import Path

from bridge.episode import metadata, schema
from bridge.episode.recover import recover
from bridge.episode.writer import EpisodeWriter, WriterConfig


def write(path: Path, kind: str, seconds: float) -> None:
    """Joints at 500 Hz, with pictures at 30 Hz when ``kind`` is mixed."""
    config = WriterConfig(flush_s=0.25, sync_s=0.5)
    with EpisodeWriter(path, config=config) as writer:
        writer.describe(metadata.EpisodeInfo(id=path.stem, kind="trial"))
        start = time.monotonic()
        sequence = 0
        while (now := time.monotonic()) - start < seconds:
            put(writer, "/joint_states", schema.JOINT_STATE, sequence, bytes(300))
            if kind == "mixed" and sequence % 16 == 0:
                put(writer, "/cam/a/color/image", schema.COMPRESSED_IMAGE, sequence, bytes(50_000))
            writer.tick()
            sequence += 1
            time.sleep(max(0.0, start + sequence * 0.002 - now))
        sys.stdout.write("closing\n")
        sys.stdout.flush()
    sys.stdout.write("closed\n")
    sys.stdout.flush()


def put(writer: EpisodeWriter, topic: str, type_name: str, sequence: int, data: bytes) -> None:
    """Write one message and report it."""
    now_ns = time.monotonic_ns()
    writer.write(topic, data, type_name=type_name, log_time_ns=now_ns, sequence=sequence)
    sys.stdout.write(f"{topic} {sequence} {now_ns}\n")
    sys.stdout.flush()


def main() -> None:
    """Do what the command line says."""
    if sys.argv[1] == "write":
        write(Path(sys.argv[2]), sys.argv[3], float(sys.argv[4]))
    else:
        sys.stdout.write("recovering\n")
        sys.stdout.flush()
        recover(Path(sys.argv[2]))


if __name__ == "__main__":
    main()
