"""Change the code at places drawn at random and see whether the tests near by notice.

The seed is the commit, so each commit is asked something else. A mutation is applied in a temporary
copy, never in the checkout, and the tests that mirror or import its module run there with ``-x``.
It is caught when a test fails that passes on the unchanged copy; it survives when all pass.

Exit codes: 0 at least four of five were caught, 3 fewer.
"""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from draw import PACKAGES, Mutant, draw, near_tests
from own_process import imports_from

ROOT = Path(__file__).resolve().parents[2]
COPIED = (*PACKAGES, "tests", "benchmarks", "datasets", "docs", "examples", "README.md")
COPIED += ("CONTRIBUTING.md", "CHANGELOG.md", "pyproject.toml", "robot_gst.py")
ENOUGH = 0.8
LIMIT_S = 300.0
"""A run that takes longer is an error: it says neither caught nor survived."""
PYTEST = ("-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--hypothesis-seed=0")
MARKS = "not gpu and not hardware and not network"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the tests said of one mutant."""

    id: str
    outcome: str
    """caught, survived or error."""
    by: str
    """The test that failed, or what is wrong."""
    took_s: float


class Copy:
    """A copy of the packages and tests, in which one mutation at a time is applied."""

    def __init__(self, folder: Path) -> None:
        """Copy the checkout; files keep their times, so that compiled ones stay valid."""
        self.folder = folder
        for name in COPIED:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, folder / name)
            else:
                shutil.copy2(ROOT / name, folder / name)
        # Processes of the tests import from here too.
        site = folder / ".site"
        site.mkdir()
        (site / "sitecustomize.py").write_text(imports_from(folder))
        self._env = os.environ | {
            "PYTHONPATH": str(site),
            "GST_CHECKOUT": str(folder),
            "OMP_NUM_THREADS": "1",
        }
        self._ticks = 0

    def run(self, mutant: Mutant, limit_s: float) -> Outcome:
        """Apply a mutation, run its tests and take it back."""
        file = self.folder / mutant.path
        original, times = file.read_text(), file.stat()
        names = near_tests(mutant.path)
        if not names:
            return Outcome(id=mutant.id, outcome="survived", by="no test is near", took_s=0.0)
        file.write_text(mutant.applied(original))
        # Compiled files are told apart by whole seconds and size: give each change its own second.
        self._ticks += 1
        os.utime(file, (times.st_mtime, times.st_mtime - 10 * self._ticks))
        started_s = time.monotonic()
        try:
            code, output = self.pytest(names, limit_s)
        finally:
            file.write_text(original)
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
        took_s = round(time.monotonic() - started_s, 1)
        outcome, by = judged(code, output)
        return Outcome(id=mutant.id, outcome=outcome, by=by, took_s=took_s)

    def pytest(self, arguments: list[str], limit_s: float) -> tuple[int | None, str]:
        """Run pytest here; without a code when it took too long."""
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", "-m", MARKS, *PYTEST, *arguments],
            cwd=self.folder,
            env=self._env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            return None, output
        return process.returncode, output


def judged(code: int | None, output: str) -> tuple[str, str]:
    """Turn what pytest said into an outcome and the test that failed."""
    failed = failing(output)
    if code == 1 and failed:
        return "caught", failed[0]
    if code == 0:
        return "survived", ""
    why = {None: "it took too long", 5: "no test was chosen"}
    last = next((line for line in reversed(output.splitlines()) if line.strip()), "")
    return "error", why.get(code, f"pytest ended with {code}: {last}")


def failing(output: str) -> list[str]:
    """Names of the tests that pytest lists as failed."""
    return re.findall(r"^(?:FAILED|ERROR) (\S+::.+?)(?: - .*)?$", output, flags=re.MULTILINE)


def run_all(mutants: list[Mutant], jobs: int, limit_s: float) -> list[Outcome]:
    """Run all mutants, ``jobs`` at a time, and see that their tests pass without them."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copies: SimpleQueue[Copy] = SimpleQueue()
        for index in range(jobs):
            copies.put(Copy(Path(folder) / str(index)))

        def one(mutant: Mutant) -> Outcome:
            copy = copies.get()
            try:
                outcome = copy.run(mutant, limit_s)
            finally:
                copies.put(copy)
            print(f"{outcome.outcome:9} {outcome.id:70} {outcome.took_s:6.1f} s  {outcome.by}")
            sys.stdout.flush()
            return outcome

        with ThreadPoolExecutor(jobs) as pool:
            outcomes = list(pool.map(one, mutants))
        return confirmed(outcomes, copies.get(), limit_s)


def confirmed(outcomes: list[Outcome], copy: Copy, limit_s: float) -> list[Outcome]:
    """Run the tests that failed once more without any mutation: there they must pass."""
    # A file name and test are enough: what pytest prints of a parameter is not always its name.
    names = sorted({item.by.partition("[")[0] for item in outcomes if item.outcome == "caught"})
    broken: set[str] = set()
    for _ in range(len(names)):
        code, output = copy.pytest([*(n for n in names if n not in broken)], 20 * limit_s)
        found = {name.partition("[")[0] for name in failing(output)}
        if code == 0 or not found:
            break
        broken |= found
    return [
        Outcome(id=o.id, outcome="error", by=f"fails without it too: {o.by}", took_s=o.took_s)
        if o.outcome == "caught" and o.by.partition("[")[0] in broken
        else o
        for o in outcomes
    ]


def main() -> int:
    """Draw, run and say what no test noticed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--draw", type=int, default=1, help="another draw of the same commit")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--limit-s", type=float, default=LIMIT_S, help="longest run of one mutant")
    parser.add_argument("--output", type=Path, help="write the outcomes as JSON")
    arguments = parser.parse_args()
    asked = ["git", "rev-parse", "HEAD"]
    commit = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    mutants = draw(f"{commit.strip()}/{arguments.draw}", arguments.count)
    started_s = time.monotonic()
    outcomes = run_all(mutants, max(1, min(arguments.jobs, len(mutants))), arguments.limit_s)
    if arguments.output:
        records = [asdict(outcome) for outcome in outcomes]
        arguments.output.write_text(json.dumps(records, indent=1) + "\n")
    for item in outcomes:
        if item.outcome != "caught":
            print(f"{item.outcome:9} {item.id}  {item.by}")
    kinds = [item.outcome for item in outcomes]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in ("caught", "survived", "error"))
    print(f"{len(outcomes)} mutants: {counts}, in {time.monotonic() - started_s:.0f} s")
    return 0 if kinds.count("caught") >= ENOUGH * len(kinds) else 3


if __name__ == "__main__":
    sys.exit(main())
