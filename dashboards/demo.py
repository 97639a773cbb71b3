"""The demo: the real commands, one after the other, on the stand-in cell.

Recorder, gate and stand-in cell are separate processes that talk zenoh on the loopback address,
exactly as a user would start them. Nothing here computes a result.
"""

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

from cyclopts import Parameter

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, refuse_outside
from bridge.task.task_file import load_task
from bridge.terminal import Output
from dashboards.config import PORTS
from dashboards.errors import DashboardError

START_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 20.0


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """What the demo does."""

    quick: bool = False
    """Two trials per condition and a short rebuild."""
    full: bool = False
    """Ten trials per condition, the number the paper used, and a longer rebuild."""
    seed: int = 1
    """Start positions and grasp errors of the trials; the cell's hidden parameters too."""
    task: str = "cube_into_box"
    """Task of the trials: cube_into_box, sloth_into_basket or five_ducks_into_basket."""
    serve: bool | None = None
    """Keep the dashboard running until Ctrl-C. Default: only on a terminal."""
    port: int = 0
    """Port of the dashboard; 0 takes a free one."""

    def __post_init__(self) -> None:
        """Refuse now what would end the demo after minutes."""
        refuse_outside(self, PORTS)

    @property
    def trials(self) -> int:
        """Trials per condition."""
        return 10 if self.full else 2 if self.quick else 3

    @property
    def budget(self) -> str:
        """Time the rebuild may take."""
        return "90s" if self.full else "15s" if self.quick else "40s"

    @property
    def samples(self) -> int:
        """Varied replays behind each verdict; toys take seconds for each, and have none."""
        return 0 if self.quick or load_task(self.task).soft_objects else 8


class StepFailedError(DashboardError):
    """One of the demo's commands failed; its own message was printed above."""

    def __init__(self, *, command: str, code: int, log: Path | None) -> None:
        """Remember the command and its exit code."""
        self.command = command
        self.code = code
        where = f" Its output is in {log}." if log else ""
        super().__init__(f"'{command}' ended with exit code {code}.{where}")


@dataclass(kw_only=True)
class Background:
    """A command left running, ended by its own process id."""

    command: str
    process: subprocess.Popen[bytes]
    log: Path

    def wait_until(self, ready: Callable[[], bool]) -> None:
        """Wait until it answers; raises when it ends or stays silent."""
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline:
            code = self.process.poll()
            if code is not None:
                raise StepFailedError(command=self.command, code=code, log=self.log)
            if ready():
                return
            time.sleep(0.1)
        message = f"'{self.command}' did not answer in {START_TIMEOUT_S:.0f} s; see {self.log}."
        raise DashboardError(message)

    def stop(self) -> None:
        """Ask it to finish, as Ctrl-C would, and insist after a while."""
        _stop(self.process)


def _stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def run_demo(path: Path, config: DemoConfig, output: Output) -> int:
    """Record, rebuild, replay, evaluate, and say what to look at next."""
    started = time.monotonic()
    load_task(config.task)  # refuse an unknown one before anything is made
    run = RunFolder.create(path)
    with _ending_on_sigterm():
        _steps(run, config, output)
    seconds = time.monotonic() - started
    _close(run, config, output, seconds)
    return 0


def _steps(run: RunFolder, config: DemoConfig, output: Output) -> None:
    path = str(run.path)
    if run.episodes():
        output.say(
            f"{path} holds {len(run.episodes())} episodes already: they are kept and used. "
            "For a fresh recording choose another folder."
        )
        if not (run.scene_dir / "scene.json").is_file():  # an earlier demo was cut off
            _step(output, "3/6 rebuilding the scene", ["rebuild", path])
    else:
        _record(run, config, output)
    replay = ["replay", path, "--samples", str(config.samples)]
    _step(output, "5/6 replaying every plan and execution in PyBullet", replay)
    _step(output, "6/6 evaluating", ["evaluate", path], show_result=True)


@contextmanager
def _ending_on_sigterm() -> Iterator[None]:
    """Make SIGTERM end the demo as Ctrl-C does, so that what it started ends with it."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _record(run: RunFolder, config: DemoConfig, output: Output) -> None:
    path = str(run.path)
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    logs = run.notes_dir / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    standin = ["publish", "standin", "--connect", endpoint, "--seed", str(config.seed)]
    standin += ["--task", config.task]
    output.say("1/6 starting the recorder (zenoh on the loopback address)")
    recorder = _start(["record", path, "--listen", endpoint], logs / "record.log")
    gate: Background | None = None
    try:
        recorder.wait_until(lambda: _answers(endpoint, "rec/main/ctl/status"))
        _step(output, "2/6 the stand-in cell scans its table", [*standin, "--trials", "0"])
        rebuild = ["rebuild", path, "--budget", config.budget]
        _step(output, f"3/6 rebuilding the scene ({config.budget})", rebuild)
        judge = ["gate", path, "--connect", endpoint, "--task", config.task]
        gate = _start(judge, logs / "gate.log")
        gate.wait_until(lambda: "ready" in (logs / "gate.log").read_text(errors="replace"))
        trials = [*standin, "--no-scan", "--ask-always", "--trials", str(config.trials)]
        label = f"4/6 {2 * config.trials} trials: {config.trials} without and with replanning"
        _step(output, label, trials)
    finally:
        if gate is not None:
            gate.stop()
        recorder.stop()


def _program() -> str:
    """The command as this shell finds it: with the environment's folder where it is not active."""
    if shutil.which("robot-gst"):
        return "robot-gst"
    return os.path.relpath(Path(sys.executable).parent / "robot-gst")


def _command(arguments: list[str]) -> list[str]:
    return [sys.executable, "-m", "robot_gst", *arguments]


def _step(output: Output, label: str, arguments: list[str], *, show_result: bool = False) -> None:
    output.say(label)
    started = time.monotonic()
    quiet = ["--quiet"] if output.quiet else []
    stdout = None if show_result and not output.json else subprocess.DEVNULL
    process = subprocess.Popen(_command([*arguments, *quiet]), stdout=stdout)
    try:
        code = process.wait()
    finally:
        _stop(process)
    if code != 0:
        raise StepFailedError(command=f"robot-gst {' '.join(arguments)}", code=code, log=None)
    output.say(f"    {time.monotonic() - started:.0f} s: robot-gst {' '.join(arguments)}")


def _start(arguments: list[str], log: Path) -> Background:
    with log.open("wb") as stream:
        process = subprocess.Popen(
            _command(arguments),
            stdout=stream,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
    return Background(command=f"robot-gst {' '.join(arguments)}", process=process, log=log)


def _answers(endpoint: str, key: str) -> bool:
    from bridge.wire.config import WireConfig  # noqa: PLC0415  # zenoh only when recording
    from bridge.wire.session import open_session  # noqa: PLC0415

    try:
        with open_session(WireConfig(connect=(endpoint,))) as session:
            session.query(key, b"{}", timeout_s=1.0)
    except GstError:
        return False
    return True


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _close(run: RunFolder, config: DemoConfig, output: Output, seconds: float) -> None:
    path, program = run.path, _program()
    summary = {
        "run": str(path),
        "seconds": round(seconds, 1),
        "episodes": len(run.episodes()),
        "replays": len(run.derived("*.replay.*")),
        "report": str(run.results_dir / "report.html"),
    }
    text = (
        f"\nDone in {seconds:.0f} s: {summary['episodes']} episodes, {summary['replays']} replays. "
        "All of it is from the stand-in cell, none of it is a real robot.\n"
        "Look at next:\n"
        f"  {summary['report']}   success table and agreement in one file\n"
        f"  {program} ls {path}          what was recorded\n"
        f"  {program} view {path}        the newest trial and the rebuilt scene in Rerun\n"
        f"  {program} dashboard {path}   review pages"
    )
    output.result(summary, text)
    serve = sys.stdout.isatty() if config.serve is None else config.serve
    if serve:
        os.execv(  # the dashboard takes this process over, so Ctrl-C reaches it directly
            sys.executable, _command(["dashboard", str(path), "--port", str(config.port)])
        )
