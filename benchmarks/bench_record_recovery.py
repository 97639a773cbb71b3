"""How fast a killed writer's file becomes a readable one, in wall time, ours and the official."""

import os
import statistics
import tempfile
import time
from pathlib import Path

from measure import Target, report_targets
from record.loads import SECONDS, load, write_official, write_ours

REPEATS = 5


def recover_again(whole: bytes, folder: Path) -> tuple[list[float], int]:
    """Cut a file at nine tenths and recover it, several times over."""
    from bridge.episode.recover import recover

    times, messages = [], 0
    for _ in range(REPEATS + 1):
        part = folder / "cut.mcap.part"
        part.write_bytes(whole[: len(whole) * 9 // 10])
        start = time.perf_counter()
        report = recover(part)
        times.append(time.perf_counter() - start)
        messages = report.messages
        report.output.unlink()
    return times[1:], messages


def main() -> None:
    """Memory as the disk: forcing data to a real one costs what that disk costs."""
    from bridge.episode.writer import WriterConfig

    memory = Path("/dev/shm")
    targets, times = [], {}
    data = load("mixed")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as name:
        folder = Path(name)
        files = {
            "ours": write_ours(folder / "ours.mcap", data, WriterConfig(flush_s=0.25)),
            "ours unpacked": write_ours(
                folder / "u.mcap", data, WriterConfig(flush_s=0.25, compress=False)
            ),
            "mcap zstd": write_official(folder / "zstd.mcap", data, "ZSTD"),
            "mcap none": write_official(folder / "none.mcap", data, "NONE"),
        }
        for label, path in files.items():
            whole = path.read_bytes()
            spent, messages = recover_again(whole, folder)
            what = f"recovery of {label}"
            times[what] = spent
            targets.append(
                Target(
                    what=what,
                    measured=len(whole) * 0.9 / 1e6 / statistics.median(spent),
                    limit=300.0,
                    unit="MB/s",
                    at_most=False,
                    reference=f"{len(whole) / 1e6:.0f} MB, {messages} messages",
                )
            )
    note = f"mixed load of {SECONDS:g} s, wall time, medians of {REPEATS}"
    report_targets("record_recovery", targets, note=note, times=times)


if __name__ == "__main__":
    if SECONDS < 4:
        os.environ.setdefault("GST_BENCH_RESULTS", tempfile.mkdtemp())
    main()
