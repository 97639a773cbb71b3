"""Many episodes: two processes against one, a Ray cluster against two processes, and a kill.

The episodes are recorded trials of the stand-in cell (development seeds) under many names; every
replay starts from nothing, localisation included, as ``robot-gst replay`` does it. Wall time, so
only an idle machine with two cores gives a number worth keeping. What is compared runs in turns,
and the median of the turns' ratios counts: a core of a shared machine is up to 1.5 times faster in
some minutes than in others.
The cluster is one that runs already, on the same two cores; what a command waits for, from the
import of ray to the last answer, counts. First argument: episodes.
"""

import hashlib
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from measure import ROOT, Target, report_targets

EPISODES, RECORDED = 100, 4
TURNS, TURNS_ALONE = 5, 3
CALM_S = 20.0
"""After its start a cluster computes for some seconds."""
SEED = 70
TASK = "cube_into_box"


def replay(run: Path, *options: str) -> list[str]:
    return [sys.executable, str(ROOT / "robot_gst.py"), "replay", str(run), "--quiet", *options]


def forget(run: Path) -> None:
    shutil.rmtree(run / "derived", ignore_errors=True)
    (run / "derived").mkdir()


def timed(run: Path, *options: str, token: Mapping[str, str] | None = None) -> float:
    """Replay a run from nothing [s]."""
    forget(run)
    before = time.monotonic()
    environment = {**os.environ, **(token or {})}
    command = replay(run, *options)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
    return time.monotonic() - before


def digests(run: Path) -> dict[str, str]:
    """What the derived files hold, byte for byte."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted((run / "derived").iterdir())
    }


def killed_and_resumed(run: Path, whole_s: float, *options: str) -> tuple[float, int]:
    """Kill a replay half way, go on; how long both took together, and files made twice."""
    forget(run)
    before = time.monotonic()
    running = subprocess.Popen(replay(run, *options), stdout=subprocess.DEVNULL)
    time.sleep(0.6 * whole_s)
    running.send_signal(signal.SIGKILL)
    running.wait()
    spent_s = time.monotonic() - before
    made = {path: path.stat().st_mtime_ns for path in (run / "derived").glob("*.mcap")}
    time.sleep(5)  # what was being done ends with its owner, or is finished
    before = time.monotonic()
    subprocess.run(replay(run, *options), check=True, stdout=subprocess.DEVNULL)
    again = sum(path.stat().st_mtime_ns != stamp for path, stamp in made.items())
    return spent_s + time.monotonic() - before, again


@contextmanager
def ray_cluster(folder: Path) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Have a cluster of two processors that has come to rest; its address, and its token."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    start = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block"]
    start += ["--node-ip-address", "127.0.0.1", "--port", address.partition(":")[2]]
    start += ["--num-cpus", "2", "--include-dashboard", "false", "--temp-dir", str(folder)]
    with subprocess.Popen(
        start, env={**os.environ, **token}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as head:
        try:
            time.sleep(CALM_S)
            yield address, token
        finally:
            head.terminate()


def measure(folder: Path, episodes: int) -> Sequence[Target]:
    from cell_run import record_ungated, with_copies

    from bridge.episode.run_folder import RunFolder

    recorded = RunFolder.create(folder / "recorded")
    paths = record_ungated(recorded, TASK, SEED, RECORDED)
    run = RunFolder.create(folder / "run")
    with_copies(run, paths, episodes)

    took: dict[str, list[float]] = {"1": [], "2": [], "ray": []}
    seen: list[dict[str, str]] = []
    for turn in range(TURNS):
        for workers in ("1", "2") if turn < TURNS_ALONE else ("2",):
            took[workers].append(timed(run.path, "--workers", workers))
            seen.append(digests(run.path))
        with ray_cluster(folder / f"ray{turn}") as (address, token):
            took["ray"].append(timed(run.path, "--ray", address, token=token))
        seen.append(digests(run.path))
    one_s, two_s, ray_s = took.values()
    resumed_s, again = killed_and_resumed(run.path, median(two_s), "--workers", "2")
    seen.append(digests(run.path))
    different = sum(other != seen[0] for other in seen[1:])
    about = f"{episodes} episodes: 1 process {_all(took['1'])}, 2 processes {_all(took['2'])}"
    return [
        Target(what="2 processes against 1", measured=_ratio(one_s, two_s), limit=1.8, unit="x",
               at_most=False, reference=about),
        Target(what="a Ray cluster that runs against 2 processes",
               measured=100 * (_ratio(ray_s, two_s) - 1), limit=5.0, unit="%",
               reference=_all(took["ray"])),
        Target(what="kill -9 at 60 % and resumed against uninterrupted",
               measured=resumed_s / median(two_s), limit=1.25, unit="x"),
        Target(what="files made twice after the kill", measured=again, limit=0),
        Target(what="runs with other bytes than the first", measured=different, limit=0,
               reference=f"{len(seen)} runs: 1 and 2 processes, Ray, killed and resumed"),
    ]  # fmt: skip


def _ratio(these: Sequence[float], those: Sequence[float]) -> float:
    """Compare what ran one after the other; the first may have run in fewer turns."""
    return median(this / that for this, that in zip(these, those, strict=False))


def _all(seconds: Sequence[float]) -> str:
    return "/".join(f"{value:.1f}" for value in seconds) + " s"


def main() -> None:
    """Record, then replay again and again."""
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else EPISODES
    with tempfile.TemporaryDirectory(prefix="robot-gst-scale-") as folder:
        targets = measure(Path(folder), episodes)
    note = (
        f"{episodes} episodes ({RECORDED} recorded ones under many names), {TASK}, wall time, "
        f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the end"
    )
    report_targets("replay_scale", targets, note=note)


if __name__ == "__main__":
    main()
