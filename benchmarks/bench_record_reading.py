"""Reading one small topic: chunks grouped by stream against everything in the same chunks."""

import os
import statistics
import tempfile
from functools import partial
from pathlib import Path

from measure import Target, cpu_seconds, report_targets
from record.loads import SECONDS, load, write_official, write_ours

TOPIC = "/c/joint_states"
REPEATS = 5


def read(path: Path, topics: list[str] | None) -> int:
    """Read with the official reader, CRCs on."""
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return sum(1 for _ in reader.iter_messages(topics=topics))


def main() -> None:
    """The mixed load: JPEG, raw depth, joints and gripper."""
    from bridge.episode.writer import WriterConfig

    data = load("mixed")
    with tempfile.TemporaryDirectory() as folder:
        as_recorded = WriterConfig(flush_s=0.25)
        grouped = write_ours(Path(folder) / "ours.mcap", data, as_recorded)
        mixed = write_official(Path(folder) / "official.mcap", data, "ZSTD")
        counts = {read(path, [TOPIC]) for path in (grouped, mixed)}
        if len(counts) != 1:
            message = f"the two files do not hold the same messages: {counts}"
            raise RuntimeError(message)
        times = {
            f"{name} {what}": cpu_seconds(partial(read, path, topics), repeats=REPEATS)
            for name, path in (("grouped", grouped), ("mixed", mixed))
            for what, topics in (("one topic", [TOPIC]), ("all", None))
        }
        sizes = f"{grouped.stat().st_size / 1e6:.0f} v {mixed.stat().st_size / 1e6:.0f} MB"
    medians = {name: statistics.median(row) for name, row in times.items()}
    one = f"{medians['grouped one topic'] * 1e3:.1f} v {medians['mixed one topic'] * 1e3:.1f} ms"
    every = f"{medians['grouped all'] * 1e3:.0f} v {medians['mixed all'] * 1e3:.0f} ms"
    report_targets(
        "record_reading",
        [
            Target(
                what="reading one small topic, times faster",
                measured=medians["mixed one topic"] / medians["grouped one topic"],
                limit=5.0,
                at_most=False,
                reference=f"{one}; all messages {every}; {sizes}",
            ),
        ],
        note=f"{SECONDS:g} s, the same reader, CPU time, medians of {REPEATS}",
        times=times,
    )


if __name__ == "__main__":
    if SECONDS < 4:
        os.environ.setdefault("GST_BENCH_RESULTS", tempfile.mkdtemp())
    main()
