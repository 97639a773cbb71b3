"""Our episode writer against the bare ``mcap`` writer on the same serialised messages."""

import io
import tempfile
from pathlib import Path

import numpy as np
from measure import cpu_seconds, report

SECONDS = 4


def messages() -> list[tuple[str, str, int, bytes]]:
    """Two cameras at 30 Hz with noisy depth and joints at 500 Hz."""
    from bridge.episode import schema
    from bridge.episode.records import CompressedColor, DepthImage, JointSample

    rng = np.random.default_rng(0)
    slope = np.tile(np.linspace(600, 1800, 640), (480, 1))
    found = []
    for index in range(30 * SECONDS):
        stamp_ns = index * 33_333_333
        for camera in ("side", "wrist"):
            noisy = slope + rng.normal(0, 1.2e-6 * slope**2)
            depth = DepthImage(
                stamp_ns=stamp_ns, frame_id=camera, depth_mm=noisy.astype(np.uint16)
            ).to_cdr()
            color = CompressedColor(
                stamp_ns=stamp_ns, frame_id=camera, format="jpeg", data=rng.bytes(55_000)
            ).to_cdr()
            found.append((f"/c/cam/{camera}/depth/image", schema.IMAGE, stamp_ns, depth))
            found.append((f"/c/cam/{camera}/color/image", schema.COMPRESSED_IMAGE, stamp_ns, color))
    for index in range(500 * SECONDS):
        stamp_ns = index * 2_000_000
        joints = JointSample(
            stamp_ns=stamp_ns,
            names=tuple("abcdef"),
            position=rng.normal(size=6),
            velocity=np.zeros(6),
            effort=np.zeros(6),
        ).to_cdr()
        found.append(("/c/joint_states", schema.JOINT_STATE, stamp_ns, joints))
    return sorted(found, key=lambda item: item[2])


def main() -> None:
    """Write the same four seconds with both."""
    from mcap.writer import CompressionType, Writer

    from bridge.episode import schema
    from bridge.episode.metadata import EpisodeInfo
    from bridge.episode.writer import EpisodeWriter

    data = messages()
    with tempfile.TemporaryDirectory() as folder:

        def ours() -> None:
            path = Path(folder) / "ours.mcap"
            path.unlink(missing_ok=True)
            with EpisodeWriter(path) as writer:
                for topic, name, stamp_ns, payload in data:
                    writer.write(topic, payload, type_name=name, log_time_ns=stamp_ns)
                writer.describe(EpisodeInfo(id="bench", kind="trial"))

        def bare() -> None:
            writer = Writer(io.FileIO(f"{folder}/bare.mcap", "w"), compression=CompressionType.ZSTD)
            writer.start(profile="ros2")
            ids: dict[str, int] = {}
            for topic, name, stamp_ns, payload in data:
                if topic not in ids:
                    known = schema.schema_for(name)
                    schema_id = writer.register_schema(name, known.schema_encoding, known.data)
                    ids[topic] = writer.register_channel(topic, "cdr", schema_id)
                writer.add_message(ids[topic], stamp_ns, payload, stamp_ns)
            writer.finish()

        rows = {
            "mcap Writer, zstd": cpu_seconds(bare, repeats=5),
            "EpisodeWriter": cpu_seconds(ours, repeats=5),
        }
    note = f"{SECONDS} s of 2 x 640x480 RGB-D at 30 Hz and joints at 500 Hz, noisy depth"
    report("episode_writer", rows, reference="mcap Writer, zstd", note=note)


if __name__ == "__main__":
    main()
