"""``robot-gst ls`` over 10,000 episodes: from the catalogue, and by opening every file."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from measure import ROOT, Target, report_targets

FULL = 10_000
NUM_EPISODES = int(os.environ.get("CATALOGUE_EPISODES", FULL))
if NUM_EPISODES != FULL:  # a number that proves nothing does not replace one that does
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
REPEATS = 5


def wall_seconds(work: Callable[[], object], repeats: int = REPEATS) -> list[float]:
    times = []
    for _ in range(repeats):
        start_s = time.perf_counter()
        work()
        times.append(time.perf_counter() - start_s)
    return times


def main() -> None:
    """Tiny episodes of a few tasks and outcomes."""
    from bridge.episode.catalogue import list_episodes, read_entry
    from bridge.episode.metadata import EpisodeInfo, Outcome
    from bridge.episode.run_folder import RunFolder
    from bridge.episode.writer import EpisodeWriter

    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder.create(Path(folder) / "run")
        for index in range(NUM_EPISODES):
            name = f"trial_{index:05}"
            with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
                info = EpisodeInfo(id=name, kind="trial", task=f"task_{index % 5}")
                result = "failure" if index % 7 == 0 else "success"
                writer.describe(info, outcome=Outcome(result=result))
                writer.write_foreign("/x", b"x", schema_record=None, log_time_ns=index)
        time.sleep(2.1)  # younger files are not trusted to stay as they are
        opened = wall_seconds(lambda: [read_entry(run, path) for path in run.episodes()], 1)
        first = wall_seconds(lambda: list_episodes(run), 1)
        warm = wall_seconds(lambda: list_episodes(run))
        command = [sys.executable, "robot_gst.py", "ls", str(run.path)]
        filters = ["--task", "task_1", "--outcome", "failure", "--sort", "start"]
        whole = wall_seconds(
            lambda: subprocess.run(
                [*command, *filters], cwd=ROOT, check=True, stdout=subprocess.DEVNULL
            )
        )
    reference = f"opening every file: {opened[0]:.2f} s; first listing: {first[0]:.2f} s"
    report_targets(
        "record_catalogue",
        [
            Target(
                what=f"ls with filters over {NUM_EPISODES} episodes, whole command",
                measured=statistics.median(whole),
                limit=1.0,
                unit="s",
                reference=reference,
            ),
            Target(
                what=f"all {NUM_EPISODES} entries in a running program",
                measured=statistics.median(warm),
                limit=1.0,
                unit="s",
            ),
        ],
        note=f"wall time, medians of {REPEATS}",
        whole_s=whole,
        warm_s=warm,
        first_s=first,
        opened_s=opened,
    )


if __name__ == "__main__":
    main()
