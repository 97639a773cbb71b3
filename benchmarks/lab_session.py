"""One session in the laboratory with the real commands, each a process of its own, as a user does.

A scan, ``rebuild``, a gate with default settings and four trials that it judges and does not stop;
then ``calibrate --posterior`` from those four, and a gate that knows it judges four more starts.
What is done is kept: started again, a session goes on where it was.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measure import ROOT

CELL = "lab"
BEFORE, AFTER = 4, 4
"""Trials that a gate with default settings judges, and those judged with a posterior from them."""
SAMPLES = 16
DRAWS = 32
MIN_P = 0.65
ITERATIONS = 100
READY_S, ENDS_S = 300.0, 60.0
ROUNDS = 2
"""A trial that was void is tried once more."""


@dataclass(frozen=True, kw_only=True)
class LabSession:
    """One laboratory and one task, in one run folder."""

    task: str
    seed: int
    folder: Path

    @property
    def name(self) -> str:
        """For people and for the run folder."""
        return f"{self.task}_{self.seed}"

    @property
    def run(self) -> Path:
        """Its run folder."""
        return self.folder / self.name

    @property
    def rows_file(self) -> Path:
        """There once the session is complete."""
        return self.run / "verdicts.json"

    def record(self) -> None:
        """Do what is missing of the session.

        Raises:
            subprocess.CalledProcessError: When a command failed; its output is in ``notes/logs``.
        """
        self._logs.mkdir(parents=True, exist_ok=True)
        endpoint = f"tcp/127.0.0.1:{_free_port()}"
        listening = ["record", str(self.run), "--listen", endpoint]
        with self._running("record", listening, lambda log: _answers(endpoint)):
            if not list((self.run / "episodes").glob("scan_*.mcap")):
                self._do("scan", [*self._publish(endpoint), "--trials", "0"])
            if not (self.run / "scene" / "sdf.npz").is_file():
                command = ["rebuild", str(self.run), "--iterations", str(ITERATIONS)]
                self._do("rebuild", [*command, "--threads", "1"])
            if not self._posterior():
                self._trials("before", endpoint, BEFORE, [])
                weigh = ["calibrate", str(self.run), "--posterior", "--draws", str(DRAWS)]
                self._do("posterior", [*weigh, "--workers", "1"])
            self._trials("after", endpoint, BEFORE + AFTER, ["--min-p-success", str(MIN_P)])
        rows = rows_of(self)
        self.rows_file.write_text(json.dumps(rows, indent=1) + "\n")

    @property
    def _logs(self) -> Path:
        return self.run / "notes" / "logs"

    def _posterior(self) -> bool:
        path = self.run / "scene" / "calibration.json"
        return path.is_file() and "posterior" in json.loads(path.read_text())

    def _publish(self, endpoint: str) -> list[str]:
        about = ["--task", self.task, "--cell", CELL, "--seed", str(self.seed)]
        return ["publish", "standin", "--connect", endpoint, *about]

    def _trials(self, part: str, endpoint: str, count: int, settings: list[str]) -> None:
        """Record the first so many starts, as far as they are not there."""
        judge = ["gate", str(self.run), "--connect", endpoint, "--cell", CELL, "--task", self.task]
        judge += ["--samples", str(SAMPLES), *settings]
        publish = [*self._publish(endpoint), "--no-scan", "--ask-always", "--missing"]
        publish += ["--conditions", "without_replanning", "--trials", str(count)]
        with self._running(f"gate_{part}", judge, lambda log: "gate ready" in log):
            for round_ in range(ROUNDS):
                self._do(f"trials_{part}", publish)
                void = void_trials(self.run)
                if not void or round_ == ROUNDS - 1:
                    return
                self._set_aside(void)

    def _set_aside(self, paths: list[Path]) -> None:
        folder = self.run / "notes" / "void"
        folder.mkdir(parents=True, exist_ok=True)
        for path in paths:
            for each in [path, *(self.run / "derived").glob(f"{path.stem}.*")]:
                shutil.move(each, folder / each.name)

    def _do(self, label: str, command: list[str]) -> None:
        started = time.monotonic()
        with (self._logs / f"{label}.log").open("ab") as log:
            process = _start(command, log)
            try:
                code = process.wait()
            finally:
                _stop(process)
        if code != 0:
            raise subprocess.CalledProcessError(code, ["robot-gst", *command])
        print(f"  {self.name}: {label}, {time.monotonic() - started:.0f} s", flush=True)

    @contextmanager
    def _running(
        self, label: str, command: list[str], ready: Callable[[str], bool]
    ) -> Iterator[None]:
        """Leave a command running while the context lasts."""
        path = self._logs / f"{label}.log"
        with path.open("wb") as log:
            process = _start(command, log)
            try:
                ends_s = time.monotonic() + READY_S
                while not ready(path.read_text(errors="replace")):
                    if process.poll() is not None or time.monotonic() > ends_s:
                        raise subprocess.CalledProcessError(
                            process.returncode or 1, ["robot-gst", *command]
                        )
                    time.sleep(0.2)
                yield
            finally:
                _stop(process)


def void_trials(run: Path) -> list[Path]:
    """Trials without an outcome."""
    from bridge.episode.reader import Episode

    found = []
    for path in sorted((run / "episodes").glob("trial_*.mcap")):
        outcome = Episode.open(path).outcome
        if outcome is None or outcome.result == "unknown":
            found.append(path)
    return found


def rows_of(session: LabSession) -> list[dict[str, Any]]:
    """One row per trial: what was said before, what the rule says, what happened."""
    from bridge.task.protocol import SEEDS_PER_SESSION
    from bridge.task.task_file import load_task

    task, first = load_task(session.task), session.seed * SEEDS_PER_SESSION
    rows = []
    for path in sorted((session.run / "episodes").glob("trial_*.mcap")):
        row = row_of(path, task)
        start = row.pop("start_seed") - first
        part = "before" if start < BEFORE else "after"
        rows.append({"task": task.name, "seed": session.seed, "start": start, "part": part, **row})
    return rows


def row_of(path: Path, task: Any) -> dict[str, Any]:
    """What one trial's recording says of its plan, its verdict and its end."""
    from bridge.episode import streams
    from bridge.episode.reader import Episode
    from bridge.geometry import se3
    from evaluator.metrics.geometric_rule import judge_by_geometry

    episode = Episode.open(path)
    poses, verdicts = {}, []
    for message in episode.messages():
        if message.topic == f"/{CELL}/localisation":
            record = json.loads(message.data)
            if record["found"]:
                poses[record["object"]] = se3.pose_from_record(record["T_base_object"])
        elif message.topic == f"/{CELL}/verdict":
            verdicts.append(json.loads(message.data))
    plans = [plan for _, plan in streams.plans(episode)]
    verdict = verdicts[-1] if verdicts else None
    p = (verdict or {}).get("p_success")
    outcome = episode.outcome
    return {
        "start_seed": episode.info.start_seed,
        "happened": None if outcome is None else outcome.result,
        "detail": None if outcome is None else outcome.detail,
        "planned": bool(plans),
        "said": None if verdict is None else verdict["accepted"],
        "nominal": nominal_of(verdict),
        "p_success": None if p is None else p["value"],
        "samples": None if p is None else p["n"],
        "reason": None if verdict is None else verdict["reason"],
        "geometry": judge_by_geometry(plans[-1], task, poses).value if plans else None,
    }


def nominal_of(verdict: dict[str, Any] | None) -> bool | None:
    """What the nominal replay alone says; what its samples took away is given back."""
    if verdict is None:
        return None
    if verdict["terminal"]["cause"] != "probability":
        return verdict["accepted"]
    return True


_RUNNING: list[subprocess.Popen[bytes]] = []
"""Newest last."""


def end_all() -> None:
    """End what sessions have started, the newest first: recorders finish their episodes."""
    while _RUNNING:
        _stop(_RUNNING[-1])


def _start(command: list[str], log: Any) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "robot_gst", *command],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        env=environment,
        cwd=ROOT,
    )
    _RUNNING.append(process)
    return process


def _stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(ENDS_S)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            process.kill()
            process.wait()
    if process in _RUNNING:
        _RUNNING.remove(process)


def _answers(endpoint: str) -> bool:
    from bridge.errors import GstError
    from bridge.wire.config import WireConfig
    from bridge.wire.session import open_session

    try:
        with open_session(WireConfig(connect=(endpoint,))) as session:
            session.query("rec/main/ctl/status", b"{}", timeout_s=1.0)
    except GstError:
        return False
    return True


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
