"""Time things fairly and store the numbers with the machine they came from."""

import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
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


@dataclass(frozen=True, kw_only=True)
class Target:
    """One line of a table of targets: what was measured, and what it must reach."""

    what: str
    measured: float
    limit: float
    unit: str = ""
    at_most: bool = True
    """Otherwise at least."""
    reference: str = ""
    """What the named reference reached in the same run."""

    @property
    def met(self) -> bool:
        """Whether the number is good enough; one that is none is not."""
        return self.measured <= self.limit if self.at_most else self.measured >= self.limit


def report_targets(name: str, targets: Sequence[Target], *, note: str, **details: Any) -> None:
    """Print targets with what was measured, and store them under benchmarks/results."""
    print(f"{name}: {note}")
    print_targets(targets)
    rows = [{**asdict(target), "met": target.met} for target in targets]
    about = {"machine": machine(), "software": software()}
    store(name, {"benchmark": name, "note": note, "targets": rows, **details, **about})


def print_targets(targets: Sequence[Target]) -> None:
    """One line each; what was missed says so."""
    width = max((len(target.what) for target in targets), default=0)
    for target in targets:
        sign = "<=" if target.at_most else ">="
        print(
            f"  {target.what:<{width}}  {target.measured:10.4g} {target.unit:<6} "
            f"{sign} {target.limit:<8.4g} {'ok    ' if target.met else 'MISSED'}  "
            f"{target.reference}".rstrip()
        )


def store(name: str, record: dict[str, Any]) -> None:
    """Keep a result; GST_BENCH_RESULTS names another folder than benchmarks/results."""
    folder = Path(os.environ.get("GST_BENCH_RESULTS", ROOT / "benchmarks" / "results"))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
