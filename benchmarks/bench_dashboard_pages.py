"""The first review page over 10,000 evaluated episodes: CPU time, memory, bytes; and a filter.

DASHBOARD_RUN names a run that is evaluated already; without it one is written and evaluated, which
takes some minutes.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from measure import ROOT, Target, report_targets

FULL = 10_000
NUM_EPISODES = int(os.environ.get("DASHBOARD_EPISODES", FULL))
if NUM_EPISODES != FULL:  # a number that proves nothing does not replace one that does
    os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
REPEATS = 5
BEFORE = {"first_cpu_s": 28.28, "again_cpu_s": 9.62, "peak_mb": 1305, "html_kb": 8278}
"""Measured here at 10,000 before there was an index, on the same loaded machine (d2aff47)."""
FILTERS = (
    "/?show=disagree",
    "/?q=trial_0012+without&task=cube_into_box",
    "/?sort=-name&page=120",
    "/?show=wrong_yes",
)
PROGRAM = """
import asyncio, json, resource, sys, time
from pathlib import Path
import httpx
needed_s = time.process_time()
from dashboards.app import create_app
from dashboards.library import Library
app = create_app(Library.open([Path(sys.argv[1])]))

def get(address):
    async def ask():
        transport = httpx.ASGITransport(app=app)
        base = "http://127.0.0.1:8600"
        async with httpx.AsyncClient(transport=transport, base_url=base) as client:
            return await client.get(address)
    start_s = time.process_time()
    answer = asyncio.run(ask())
    assert answer.status_code == 200, answer.text
    return answer, time.process_time() - start_s

first, _ = get("/")
first_s = time.process_time() - needed_s
found = {"first_cpu_s": first_s, "html_kb": len(first.content) / 1000}
found["filters_s"] = [get(address)[1] for address in json.loads(sys.argv[2]) * 5]
found["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
assert "Page 1 of" in first.text
print(json.dumps(found))
"""
"""Only the asking program, httpx, is loaded before the time is taken."""


def opened(run: Path) -> dict[str, Any]:
    """Open the pages in a process of their own."""
    command = [sys.executable, "-c", PROGRAM, str(run), json.dumps(FILTERS)]
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout))


def main() -> None:
    """Write, evaluate, open."""
    from evaluate_run import Size, write_run

    with tempfile.TemporaryDirectory() as folder:
        given = os.environ.get("DASHBOARD_RUN")
        run = Path(given) if given else Path(folder) / "run"
        if not given:
            write_run(run, Size(num_trials=NUM_EPISODES, seconds=0.2))
            evaluate = [sys.executable, "robot_gst.py", "evaluate", str(run), "--quiet"]
            subprocess.run(evaluate, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        found = [opened(run) for _ in range(REPEATS)]

    def middle(name: str) -> float:
        return statistics.median(each[name] for each in found)

    filters_s = [s for each in found for s in each["filters_s"]]
    before = "without an index: {}"
    report_targets(
        "dashboard_pages",
        [
            Target(
                what=f"first page at {NUM_EPISODES} episodes, new process, imports included",
                measured=middle("first_cpu_s"),
                limit=1.0,
                unit="s CPU",
                reference=before.format(BEFORE["first_cpu_s"]),
            ),
            Target(
                what="a filter, an order or another page, slowest of all",
                measured=max(filters_s),
                limit=0.15,
                unit="s CPU",
                reference=before.format(BEFORE["again_cpu_s"]),
            ),
            Target(
                what="peak memory",
                measured=middle("peak_mb"),
                limit=250,
                unit="MB",
                reference=before.format(BEFORE["peak_mb"]),
            ),
            Target(
                what="HTML of the first page, not compressed",
                measured=middle("html_kb"),
                limit=300,
                unit="kB",
                reference=before.format(BEFORE["html_kb"]),
            ),
        ],
        note=f"CPU time, medians of {REPEATS} processes; machine shared with other work",
        before=BEFORE,
        filters_median_s=statistics.median(filters_s),
        all=found,
    )


if __name__ == "__main__":
    main()
