"""``robot-gst evaluate`` over 10,000 episodes with two replays each: cold, warm, and ten new ones.

The run is written once under ``build/`` and kept. Files are read before they are timed, so "cold"
is about the evaluator's own cache, not the disk's.
"""

import json
import os
import random
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from evaluate_run import Size, paths_of, write_run
from measure import ROOT, Target, report_targets

from bridge.episode import schema
from bridge.episode.run_folder import RunFolder
from bridge.terminal import Output

FULL = 10_000
NUM_TRIALS = int(os.environ.get("EVALUATE_EPISODES", FULL))
if NUM_TRIALS != FULL:  # a number that proves nothing does not replace one that does
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
SHORT_S = 1.0
"""Length of the motions of most episodes: what takes long to write is not what is measured."""
LONG = Size(num_trials=40, seconds=20.0)
"""Episodes as they are recorded, for the time a motion takes."""
NUM_NEW = 10
SAMPLE = 1000
"""Files the reference reads."""
QUIET = Output(quiet=True)


class Ran(NamedTuple):
    """One command."""

    wall_s: float
    cpu_s: float
    """Of all its processes, which end before it does."""
    peak_mb: float
    """Largest resident memory of one of its processes."""


def bench_run() -> RunFolder:
    """Return the run of short episodes, written where it is not there."""
    folder = ROOT / "build" / f"bench_evaluate_{NUM_TRIALS}"
    done = folder / "whole"
    if not done.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        began_s = time.perf_counter()
        write_run(folder, Size(num_trials=NUM_TRIALS, seconds=SHORT_S))
        done.touch()
        print(f"wrote {3 * NUM_TRIALS} episodes in {time.perf_counter() - began_s:.0f} s")
        time.sleep(2.1)  # younger files are not trusted to stay as they are
    run = RunFolder(folder)
    for path in paths_of(run):  # what an interrupted benchmark added
        if int(path.name.split("_")[1][:6]) >= NUM_TRIALS:
            path.unlink()
    shutil.rmtree(run.results_dir, ignore_errors=True)
    return run


def into_the_disk_cache(paths: Iterable[Path]) -> None:
    """Read files; the system may have dropped what lay unused for minutes."""
    for path in paths:
        path.read_bytes()


class Spent(NamedTuple):
    """One call in this process, and in those it starts and ends."""

    wall_s: float
    cpu_s: float
    """Of all threads and processes."""


def spent(work: Callable[[], object]) -> Spent:
    """Time one call."""
    began_s, used_s = time.perf_counter(), cpu_s()
    work()
    return Spent(time.perf_counter() - began_s, cpu_s() - used_s)


def cpu_s() -> float:
    """Processor time of this process and of those it has waited for [s]."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


def evaluate(run: RunFolder) -> Ran:
    """Run the whole command in a process of its own."""
    command = [sys.executable, str(ROOT / "robot_gst.py"), "evaluate", str(run.path), "--quiet"]
    began_s = time.perf_counter()
    pid = os.posix_spawn(
        command[0],
        command,
        dict(os.environ),
        file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)],
    )
    _, status, usage = os.wait4(pid, 0)
    if os.waitstatus_to_exitcode(status):
        message = f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}"
        raise RuntimeError(message)
    used_s = usage.ru_utime + usage.ru_stime
    return Ran(time.perf_counter() - began_s, used_s, usage.ru_maxrss / 1024)


def outcomes(run: RunFolder, processes: int | None = None) -> Spent:
    """Hash and read all outcomes, nothing kept; on all cores unless told otherwise."""
    from evaluator.cache import SummaryCache
    from evaluator.compare.summaries import evaluation_pool
    from evaluator.run_reader.contents import read_contents

    def read() -> None:
        with evaluation_pool(processes) as pool:
            read_contents(run, SummaryCache(None), QUIET, pool)

    return spent(read)


def motions(run: RunFolder) -> Spent:
    """Compare motions and final states of all trials in this process, nothing kept."""
    from evaluator.cache import SummaryCache
    from evaluator.compare.run import trials_of
    from evaluator.compare.summaries import sum_up
    from evaluator.run_reader.contents import read_contents

    cache = SummaryCache(None)
    trials, _ = trials_of(read_contents(run, cache, QUIET))
    return spent(lambda: sum_up(trials, cache, QUIET))


def reference(paths: Iterable[Path]) -> Spent:
    """Read the same metadata and messages with the official reader; nothing is checked."""
    from mcap.reader import make_reader

    kinds = {schema.PLAN, schema.EVENT, schema.VERDICT, schema.LOCALISATION}

    def read(path: Path) -> None:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            for record in reader.iter_metadata():
                dict(record.metadata)
            topics = [
                channel.topic
                for channel in summary.channels.values()
                if summary.schemas[channel.schema_id].name in kinds
            ]
            for _, _, message in reader.iter_messages(topics=topics):
                json.loads(message.data)

    return spent(lambda: [read(path) for path in paths])


def main() -> None:
    """All of it, once: the cold run alone takes minutes."""
    run = bench_run()
    paths = list(paths_of(run))
    sample = random.Random(0).sample(paths, min(SAMPLE, len(paths)))
    into_the_disk_cache(paths)
    of_outcomes, of_one, of_reference = outcomes(run), outcomes(run, 1), reference(sample)
    outcome_ms = 1e3 * of_outcomes.wall_s / len(paths)
    reference_ms = 1e3 * of_reference.wall_s / len(sample)
    with tempfile.TemporaryDirectory() as folder:
        of_motions = motions(write_run(Path(folder) / "long", LONG))
    long_ms = 1e3 * of_motions.wall_s / LONG.num_trials
    cold = evaluate(run)
    warm = [evaluate(run) for _ in range(3)]
    write_run(run.path, Size(num_trials=NUM_NEW, seconds=SHORT_S), first=NUM_TRIALS)
    time.sleep(2.1)
    added = evaluate(run)
    warm_s = sorted(each.wall_s for each in warm)[1]
    warm_cpu_s = sorted(each.cpu_s for each in warm)[1]
    size_mb = sum(path.stat().st_size for path in paths) / 1e6
    report_targets(
        "evaluate_speed",
        [
            Target(
                what="outcomes, cold, hash included, per file",
                measured=outcome_ms,
                limit=2.0,
                unit="ms",
                reference=f"CPU in all {1e3 * of_outcomes.cpu_s / len(paths):.2f} ms; in one "
                f"process {1e3 * of_one.wall_s / len(paths):.2f} ms; official mcap "
                f"reader, no hash, no checks: {reference_ms:.2f} ms, CPU "
                f"{1e3 * of_reference.cpu_s / len(sample):.2f} ms",
            ),
            Target(
                what=f"trajectories, cold, per episode of {LONG.seconds:g} s at 125 Hz",
                measured=long_ms,
                limit=80.0,
                unit="ms",
                reference=f"one process, CPU {1e3 * of_motions.cpu_s / LONG.num_trials:.1f} ms",
            ),
            Target(
                what=f"{NUM_TRIALS} episodes from the cache to the report, whole command",
                measured=warm_s,
                limit=10.0,
                unit="s",
                reference=f"CPU {warm_cpu_s:.1f} s; cold, on all cores: {cold.wall_s:.1f} s, "
                f"CPU of all processes {cold.cpu_s:.1f} s",
            ),
            Target(
                what=f"the same after {NUM_NEW} new episodes",
                measured=added.wall_s,
                limit=10.0 + NUM_NEW * 0.2,
                unit="s",
                reference=f"CPU {added.cpu_s:.1f} s",
            ),
            Target(
                what="peak memory, cold",
                measured=cold.peak_mb,
                limit=2000.0,
                unit="MB",
                reference=f"warm {max(each.peak_mb for each in warm):.0f} MB",
            ),
        ],
        note=f"{len(paths)} files, {size_mb:.0f} MB, motions of {SHORT_S:g} s in 8 variants; wall "
        "time, files in the disk cache, median of 3 warm runs",
        cold_s=cold.wall_s,
        warm_s=[each.wall_s for each in warm],
        added_s=added.wall_s,
    )


if __name__ == "__main__":
    main()
