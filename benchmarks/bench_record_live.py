"""The recorder against a live cell and a reference recorder, and against everything that fails.

Options come from the command line or from the environment variable RECORD_BENCH, for example
RECORD_BENCH="--only ratio --seconds 20". Everything takes about an hour; --quick a minute or two
and proves nothing.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from measure import ROOT
from record.scenarios import SCENARIOS, Plan

QUICK = {"repeats": 1, "seconds": 3.0, "long_s": 5.0, "kills": 4, "kill_s": 1.5}


def main() -> None:
    """Run the scenarios, one after another."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few seconds of each, once")
    parser.add_argument("--only", nargs="+", choices=SCENARIOS, default=list(SCENARIOS))
    parser.add_argument("--out", type=Path, help="where episodes go; otherwise a temporary folder")
    parser.add_argument("--depth", choices=("noisy", "easy"), default="noisy")
    parser.add_argument("--repeats", type=int)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--long-s", type=float)
    parser.add_argument("--kills", type=int)
    options = parser.parse_args(sys.argv[1:] + shlex.split(os.environ.get("RECORD_BENCH", "")))
    settings = QUICK if options.quick else {}
    for name in ("repeats", "seconds", "long_s", "kills"):
        if getattr(options, name) is not None:
            settings = {**settings, name: getattr(options, name)}
    if options.quick:  # numbers that prove nothing do not replace those that do
        os.environ.setdefault("GST_BENCH_RESULTS", str(ROOT / "build" / "quick_results"))
    folder = Path(tempfile.mkdtemp(prefix="record_bench_", dir=options.out))
    try:
        plan = Plan(folder=folder, where=kind_of_disk(folder), depth=options.depth, **settings)
        for name in options.only:
            SCENARIOS[name](plan)
            sys.stdout.flush()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def kind_of_disk(folder: Path) -> str:
    """The file system under a folder, as ``stat`` names it."""
    command = ["stat", "--file-system", "--format=%T", str(folder)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
