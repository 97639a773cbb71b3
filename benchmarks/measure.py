"""Time things fairly and store the numbers with the machine they came from."""

import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from bridge.episode.provenance import software  # noqa: E402


def cpu_seconds(work: Callable[[], object], *, repeats: int) -> list[float]:
    """Process CPU time of each repeat, after one that is not counted [s]."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return times


def machine() -> dict[str, Any]:
    """What ran it."""
    model = ""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        model = next((line.split(":")[1].strip() for line in lines if "model name" in line), "")
    return {
        "cpu": model or platform.processor(),
        "cores": os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "system": platform.platform(),
    }


def report(name: str, rows: dict[str, list[float]], *, reference: str, note: str) -> None:
    """Print medians and ratios to the reference, and store them under benchmarks/results."""
    medians = {label: statistics.median(times) for label, times in rows.items()}
    print(f"{name}: {note}")
    for label, median in medians.items():
        ratio = medians[reference] / median
        print(f"  {label:<34} {median * 1e3:9.2f} ms   {ratio:7.2f} x {reference}")
    record = {
        "benchmark": name,
        "note": note,
        "unit": "CPU seconds",
        "reference": reference,
        "medians": medians,
        "repeats": {label: len(times) for label, times in rows.items()},
        "all": rows,
        "machine": machine(),
        "software": software(),
    }
    folder = ROOT / "benchmarks" / "results"
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
