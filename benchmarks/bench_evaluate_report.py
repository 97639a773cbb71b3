"""How long one report takes and how large it is, for ten thousand trials.

``--trials`` makes it smaller. What is timed: everything that ``evaluate`` writes once the numbers
are there, in a fresh process, so that loading matplotlib and pyarrow counts.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from measure import ROOT, Target, report_targets

sys.path.insert(0, str(ROOT / "tests" / "evaluator" / "report"))

SECONDS = 4.0
BYTES = 5e6


def once(trials: int) -> dict[str, float]:
    """Make a comparison of invented trials and time its report alone."""
    from test_report_size import many

    comparison = many(trials)
    from evaluator.report.write import write_report

    with tempfile.TemporaryDirectory() as folder:
        start, cpu = time.perf_counter(), time.process_time()
        written = write_report(comparison, Path(folder))
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        return {
            "seconds": seconds,
            "cpu_seconds": cpu,
            "page_bytes": written.report.stat().st_size,
            "results_bytes": written.results.stat().st_size,
            "all_bytes": sum(path.stat().st_size for path in Path(folder).rglob("*.*")),
        }


def main() -> None:
    """Time fresh processes and keep the medians."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--once", action="store_true")
    options = parser.parse_args()
    if options.once:
        print(json.dumps(once(options.trials)))
        return
    command = [sys.executable, __file__, "--once", "--trials", str(options.trials)]
    runs = []
    for _ in range(options.repeats):
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        runs.append(json.loads(done.stdout))
    middle = {name: sorted(run[name] for run in runs)[len(runs) // 2] for name in runs[0]}
    report_targets(
        "evaluate_report",
        [
            Target(what="report written", measured=middle["seconds"], limit=SECONDS, unit="s"),
            Target(what="report.html", measured=middle["page_bytes"], limit=BYTES, unit="bytes"),
        ],
        note=f"{options.trials} trials, a fresh process each, median of {options.repeats}",
        runs=runs,
    )


if __name__ == "__main__":
    main()
