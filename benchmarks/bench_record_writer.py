"""Our episode writer against the ``mcap`` package's, the same serialised messages, CPU time."""

import os
import statistics
import tempfile
from functools import partial
from pathlib import Path

from measure import Target, cpu_seconds, report_targets
from record.loads import MIXES, SECONDS, load, megabytes, write_official, write_ours

LIMITS = {"comp": 0.5, "mixed": 0.9, "raw": 0.5}
"""Ours as it records (JPEG none, depth and small zstd-1) against the official default, zstd-3."""
REPEATS = 5


def main() -> None:
    """Three mixes, uncompressed against uncompressed and default against default."""
    from bridge.episode.writer import WriterConfig

    memory = Path("/dev/shm")  # a disk's speed of the day is not the question
    targets, times = [], {}
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        ours, official = Path(folder) / "ours.mcap", Path(folder) / "official.mcap"
        for mix in MIXES:
            data = load(mix)
            works = {
                "ours none": partial(write_ours, ours, data, WriterConfig(compress=False)),
                "mcap none": partial(write_official, official, data, "NONE"),
                "ours": partial(write_ours, ours, data, WriterConfig()),
                "mcap zstd": partial(write_official, official, data, "ZSTD"),
            }
            rows = {name: cpu_seconds(work, repeats=REPEATS) for name, work in works.items()}
            times[mix] = rows
            sizes = f"{ours.stat().st_size / 1e6:.0f} v {official.stat().st_size / 1e6:.0f} MB"
            medians = {name: statistics.median(row) for name, row in rows.items()}
            for mine, theirs, limit in (
                ("ours none", "mcap none", 0.75),
                ("ours", "mcap zstd", LIMITS[mix]),
            ):
                rate = megabytes(data) / medians[mine]
                reference = f"{medians[mine]:.3f} v {medians[theirs]:.3f} s, {rate:.0f} MB/s"
                what = f"writer CPU, {mix}, {mine} / {theirs}"
                measured = medians[mine] / medians[theirs]
                note = reference if mine == "ours none" else f"{reference}, {sizes}"
                targets.append(Target(what=what, measured=measured, limit=limit, reference=note))
    note = f"{SECONDS:g} s of two cameras and joints, CPU time, medians of {REPEATS}"
    report_targets("record_writer", targets, note=note, times=times)


if __name__ == "__main__":
    if SECONDS < 4:
        os.environ.setdefault("GST_BENCH_RESULTS", tempfile.mkdtemp())
    main()
