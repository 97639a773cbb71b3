"""An episode played back at rate 1 and recorded again: is it the same, and how much do times move?

Jitter is the distance of a message's log time from where the first recording puts it, after the
median distance over all messages is taken away.
"""

import json
import os
import tempfile
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from measure import Target, report_targets
from record.children import Child
from record.frames import add_noise, native_frames, source_name
from record.recorders import OurRecorder

SECONDS = float(os.environ.get("PLAYBACK_SECONDS", "20"))
START_NS = 1_700_000_000_000_000_000
JOINTS_HZ, CAMERA_HZ, CAMERAS = 500, 30, ("a", "b")
FRAMES = 10
SHARED_MB = 64


def write_cell(path: Path) -> None:
    """Two VGA RGB-D cameras (JPEG and lossless depth) beside joints at 500 Hz."""
    from bridge.episode import schema
    from bridge.episode.cdr.messages import CompressedColor, DepthImage, JointSample
    from bridge.episode.metadata import EpisodeInfo
    from bridge.episode.writer import EpisodeWriter
    from bridge.media.color import encode_jpeg

    rng = np.random.default_rng(3)
    colors, depths = native_frames(FRAMES)
    jpegs = [encode_jpeg(color, 90) for color in colors]
    depths = [add_noise(depth, rng) for depth in depths]
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id="first", kind="trial", cell="c"))
        times = [(k / JOINTS_HZ, "") for k in range(int(SECONDS * JOINTS_HZ))]
        for camera in CAMERAS:
            shift_s = 0.0007 + 0.011 * CAMERAS.index(camera)
            times += [(k / CAMERA_HZ + shift_s, camera) for k in range(int(SECONDS * CAMERA_HZ))]
        for number, (at_s, camera) in enumerate(sorted(times)):
            at_ns = START_NS + round(at_s * 1e9)
            if not camera:
                sample = JointSample(
                    stamp_ns=at_ns,
                    names=tuple("abcdef"),
                    position=rng.normal(size=6),
                    velocity=rng.normal(size=6),
                    effort=np.zeros(0),
                )
                messages = [("/c/joint_states", sample.to_cdr(), schema.JOINT_STATE)]
            else:
                color = CompressedColor(
                    stamp_ns=at_ns, frame_id=camera, format="jpeg", data=jpegs[number % FRAMES]
                )
                depth = DepthImage(
                    stamp_ns=at_ns, frame_id=camera, depth_mm=depths[number % FRAMES]
                )
                messages = [
                    (f"/c/cam/{camera}/color/image", color.to_cdr(), schema.COMPRESSED_IMAGE),
                    (f"/c/cam/{camera}/depth/image", depth.to_cdr(), schema.IMAGE),
                ]
            for topic, data, type_name in messages:
                writer.write(topic, data, type_name=type_name, log_time_ns=at_ns)


def read(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Topic, log time, publish time and bytes of each message, as the official reader has them."""
    with path.open("rb") as stream:
        return [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(stream).iter_messages()
            if channel.topic.startswith("/c/")
        ]


def play(folder: Path, path: Path) -> tuple[Path, dict[str, float], float]:
    """Play and record in processes of their own; returns the file, lateness and processor time."""
    recorder = OurRecorder(folder)
    try:
        player = Child(
            *("robot_gst.py", "publish", "episode", str(path), "--episode", "again"),
            *("--shared-memory-mb", str(SHARED_MB)),
            *("--connect", recorder.endpoint, "--json", "--quiet"),
            log=folder / "player.log",
        )
        out, _ = player.process.communicate(timeout=SECONDS * 3 + 60)
        sent = json.loads(out)["sent"]
        cpu_s = recorder.cpu_s()
    finally:
        recorder.end()
    return recorder.run_path / "episodes" / "again.mcap", sent["late_ms"], cpu_s


def main() -> None:
    """Compare the second recording with the first."""
    with tempfile.TemporaryDirectory(prefix="playback_bench_") as name:
        folder = Path(name)
        write_cell(folder / "first.mcap")
        again, late_ms, cpu_s = play(folder, folder / "first.mcap")
        first, second = read(folder / "first.mcap"), read(again)
    same = [(topic, published, data) for topic, _, published, data in first] == [
        (topic, published, data) for topic, _, published, data in second
    ]
    moved_ms = np.array([b[1] - a[1] for a, b in zip(first, second, strict=True)]) * 1e-6
    jitter_ms = np.abs(moved_ms - np.median(moved_ms))
    is_small = np.array([topic == "/c/joint_states" for topic, *_ in first])
    small, large = np.percentile(jitter_ms[is_small], 99), np.percentile(jitter_ms[~is_small], 99)
    report_targets(
        "record_playback",
        [
            Target(
                what="messages that differ, or came in another order",
                measured=float(not same),
                limit=0.0,
            ),
            Target(
                what="jitter p99 of all messages at rate 1",
                measured=float(np.percentile(jitter_ms, 99)),
                limit=2.0,
                unit="ms",
                reference=f"joints {small:.2f}, images {large:.2f}, median "
                f"{np.median(jitter_ms):.2f} ms; they left {late_ms['p99']:.2f} ms late (p99)",
            ),
        ],
        note=f"{SECONDS:g} s of {JOINTS_HZ} Hz joints and 2 VGA RGB-D cameras at {CAMERA_HZ} Hz "
        f"({source_name()}) through {SHARED_MB} MB of shared memory, player and recorder on the "
        "same cores"
        + (", at real-time priority" if os.sched_getscheduler(0) != os.SCHED_OTHER else ""),
        messages=len(first),
        recorder_cpu_s=cpu_s,
        late_ms=late_ms,
    )


if __name__ == "__main__":
    main()
