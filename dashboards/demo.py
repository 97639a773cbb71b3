"""The demo: the real commands, one after the other, on the stand-in cell.

Recorder, gate and stand-in cell are separate processes that talk zenoh on the loopback address,
exactly as a user would start them. Nothing here computes a result. Interrupted and started again,
it keeps what is whole, records anew what is not, and adds what is missing.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bridge.ending import ending_with_me
from bridge.episode.catalogue import outcome_of, sidecar_path
from bridge.episode.mcap.part_file import lock_dead
from bridge.episode.metadata import WITHOUT, Outcome
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, refuse_full
from bridge.errors import GstError, UsageError
from bridge.heartbeat import BEAT
from bridge.sources.standin.settings import CONDITIONS, INTERRUPTED
from bridge.task.find import chosen_task_file
from bridge.task.protocol import SEEDS_PER_SESSION
from bridge.terminal import Output, how_to_activate
from dashboards.errors import DashboardError
from dashboards.standin_settings import BUILT_IN_POLICY, DemoConfig

ENOUGH_TRIALS = 20
"""In a group, before the correlation over groups is believed; robot-gst trials makes so many."""
RECORDER_READY = "listens on"
START_TIMEOUT_S = 300.0
STOP_TIMEOUT_S = 60.0


class StepFailedError(DashboardError):
    """One of the demo's commands failed; its own message was printed above."""

    def __init__(self, *, command: str, code: int, log: Path | None) -> None:
        """Remember the exit code."""
        self.code = code
        where = f" Its output is in {log}." if log else ""
        super().__init__(f"'{command}' ended with exit code {code}.{where}")


@dataclass(kw_only=True)
class Background:
    """A command left running, ended by its own process id."""

    command: str
    process: subprocess.Popen[bytes]
    log: Path

    def check(self) -> None:
        """Raise when it has ended."""
        code = self.process.poll()
        if code is not None:
            raise StepFailedError(command=self.command, code=code, log=self.log)

    def wait_for(self, words: str) -> None:
        """Wait until it has said something; raises when it ends or stays silent."""
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline:
            self.check()
            if words in self.log.read_text(errors="replace"):
                return
            time.sleep(0.1)
        message = f"'{self.command}' did not answer in {START_TIMEOUT_S:.0f} s; see {self.log}."
        raise DashboardError(message)


def stop_command(process: subprocess.Popen[bytes]) -> None:
    """Ask it to finish, as Ctrl-C would, and insist after a while or when told so twice."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_TIMEOUT_S)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            process.kill()
            process.wait()


@dataclass(frozen=True, kw_only=True, order=True)
class Group:
    """Trials of one task by one policy, under one or both conditions."""

    chosen: str
    """The task as it was asked for: its name or its file."""
    policy: str
    conditions: tuple[str, ...]

    def trials(self, config: DemoConfig) -> list["Trial"]:
        """Each start, once per condition."""
        task, first = chosen_task_file(self.chosen).task().name, config.seed * SEEDS_PER_SESSION
        return [
            Trial(task=task, policy=self.policy, start_seed=first + k, condition=condition)
            for k in range(config.trials)
            for condition in self.conditions
        ]


@dataclass(frozen=True, kw_only=True, order=True)
class Trial:
    """What tells one trial of a demo from another."""

    task: str
    policy: str
    start_seed: int
    condition: str


def groups_of(config: DemoConfig) -> list[Group]:
    """What a demo tries: every task by every policy, with replanning by the cell's own planner."""
    policies = {BUILT_IN_POLICY: CONDITIONS} | dict.fromkeys(config.other_policies, (WITHOUT,))
    return [
        Group(chosen=task, policy=policy, conditions=conditions)
        for policy, conditions in policies.items()
        for task in config.tasks
    ]


@dataclass
class Recorded:
    """What a run folder holds of a demo."""

    unscanned: list[str] = field(default_factory=list)
    """Tasks that have no scan, as they were asked for: it shows what their trials use."""
    missing: list[Trial] = field(default_factory=list)
    unusable: dict[Path, str] = field(default_factory=dict)
    void: dict[Path, str] = field(default_factory=dict)
    """Trials that were recorded to their end and have no outcome, and why."""
    num_known: int = 0


def look(run: RunFolder, config: DemoConfig) -> Recorded:
    """Say what of the demo is recorded, and what of it is of no use."""
    found = Recorded()
    unscanned = {chosen_task_file(each).task().name: each for each in config.tasks}
    trials = {trial for group in groups_of(config) for trial in group.trials(config)}
    for path in sorted(run.episodes_dir.glob("*.part")):
        descriptor = lock_dead(path)
        if descriptor is None:
            message = f"{path} is being written: another recorder works in {run.path}."
            raise UsageError(message)
        os.close(descriptor)
        found.unusable[path] = "its recorder was killed"
    for path in run.episodes():
        try:
            episode = Episode.open(path)
        except GstError as error:
            found.unusable[path] = str(error)
            continue
        info = episode.info
        _refuse_other(run, config, episode)
        outcome = outcome_of(run, episode)
        problem = cut_short(episode, outcome)
        if problem:
            found.unusable[path] = problem
        elif info.kind == "scan":
            unscanned.pop(info.task, None)
        elif info.kind == "trial" and info.start_seed is not None:
            trials.discard(
                Trial(
                    task=info.task,
                    policy=info.policy,
                    start_seed=info.start_seed,
                    condition=info.condition,
                )
            )
            if outcome is None or outcome.result == "unknown":
                found.void[path] = (outcome and outcome.detail) or "nobody labelled it"
            else:
                found.num_known += 1
    found.missing, found.unscanned = sorted(trials), list(unscanned.values())
    return found


def _refuse_other(run: RunFolder, config: DemoConfig, episode: Episode) -> None:
    info = episode.info
    if not info.stand_in:
        found = f"{episode.path.name}, which is not from the stand-in cell"
    elif info.task not in [chosen_task_file(each).task().name for each in config.tasks]:
        found = f"episodes of --task {info.task}"
    elif info.start_seed is not None and info.start_seed // SEEDS_PER_SESSION != config.seed:
        found = f"episodes of --seed {info.start_seed // SEEDS_PER_SESSION}"
    else:
        return
    message = f"{run.path} holds {found}. Give the demo that option again, or another folder."
    raise UsageError(message)


def cut_short(episode: Episode, outcome: Outcome | None) -> str:
    """What ended an episode before its time; empty when nothing did."""
    records = episode.metadata_records
    stopped_by = records.get("recorder", {}).get("stopped_by", "command")
    if "recovered" in records:
        return "its end is missing"
    if stopped_by != "command":
        return str(stopped_by)
    return INTERRUPTED if outcome is not None and outcome.detail == INTERRUPTED else ""


def set_aside(run: RunFolder, path: Path, why: str, output: Output) -> None:
    """Move an episode, and all that was made of it, to where no command looks for episodes."""
    folder = run.notes_dir / INTERRUPTED / time.strftime("%Y%m%d_%H%M%S")
    folder.mkdir(parents=True, exist_ok=True)
    name = path.name.split(".")[0]
    output.say(f"    {path.name} is recorded anew ({why}); this one goes to {folder}")
    belonging = [*run.episodes_dir.glob(f"{name}.*"), *run.derived_dir.glob(f"{name}.*")]
    for each in [*belonging, sidecar_path(run, name)]:
        if each.exists():
            shutil.move(each, folder / each.name)


def run_demo(path: Path, config: DemoConfig, output: Output) -> int:
    """Record, rebuild, replay, evaluate, and say what to look at next."""
    started = time.monotonic()
    for each in config.tasks:
        chosen_task_file(each).task()  # refuse an unknown one before anything is made
    run = RunFolder.create(path)
    refuse_full(run.path)
    with ending_on_signals():
        void = _record(run, config, output).void
        replay = ["replay", str(path), "--samples", str(config.samples)]
        step(output, "5/6 replaying every plan and execution in PyBullet", replay)
        step(output, "6/6 evaluating", ["evaluate", str(path)], show_result=True)
        _refuse_nothing(run)
    _close(run, config, output, time.monotonic() - started, void)
    return 0


@contextmanager
def ending_on_signals() -> Iterator[None]:
    """Let SIGTERM and a closed terminal end the demo as Ctrl-C does, with all that it started."""
    signals = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(each, signal.default_int_handler) for each in signals]
    try:
        yield
    finally:
        for each, handler in zip(signals, before, strict=True):
            signal.signal(each, handler)


def _record(run: RunFolder, config: DemoConfig, output: Output) -> Recorded:
    """Do the steps 1 to 4, as far as they have not been done, and say what there is then."""
    path = str(run.path)
    found = look(run, config)
    useless = found.unusable | found.void
    for episode, why in useless.items():
        set_aside(run, episode, why, output)
    if useless:
        found = look(run, config)
    if not found.unscanned and not found.missing:
        output.say(f"1/6 to 4/6: {path} holds all scans and trials; they are kept and used")
        if not _scene(run):
            _rebuild(path, config, output)
        return found
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    logs = run.notes_dir / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    standin = ["publish", "standin", "--connect", endpoint, "--seed", str(config.seed)]
    output.say("1/6 starting the recorder (zenoh on the loopback address)")
    record = ["record", path, "--listen", endpoint]
    with running(record, logs / "record.log", RECORDER_READY) as recorder:
        if not found.unscanned:
            output.say("2/6 the scans are recorded; they are kept and used")
        for task in found.unscanned:  # each from a start of its own: what one hides another shows
            start = ["--first-start", str(config.tasks.index(task))]
            scan_task(task, [*standin, *start], output, recorder, label="2/6 ")
        if not found.unscanned and _scene(run):
            output.say("3/6 the scene is rebuilt; it is kept and used")
        else:
            _rebuild(path, config, output, recorder)
        if found.missing:
            _record_trials(run, config, endpoint, standin, found.missing, recorder, output)
    found = look(run, config)
    cause = next(iter((found.void | found.unusable).values()), "the session was stopped")
    if found.unscanned:
        which = ", ".join(Path(each).stem for each in found.unscanned)
        raise DashboardError(f"there is no scan for {which}: {cause}. Start the demo again.")
    if found.missing or not found.num_known:
        count = len(found.missing) + len(found.void)
        asked = sum(len(group.trials(config)) for group in groups_of(config))
        message = f"{count} of {asked} trials have no outcome: {cause}. "
        raise DashboardError(f"{message}Start the demo again; it adds what is missing.")
    return found


def scan_task(
    task: str, standin: list[str], output: Output, recorder: Background, *, label: str = ""
) -> None:
    """Record what the trials of a task use, so that ``rebuild`` knows it before they begin."""
    words = [*standin, "--task", task, "--trials", "0"]
    step(output, f"{label}the stand-in cell scans what {Path(task).stem} uses", words, recorder)


def _rebuild(path: str, config: DemoConfig, output: Output, *beside: Background) -> None:
    cameras = ["calibrate", path, "--cameras"]
    step(output, "3/6 finding where the cameras really are", cameras, *beside)
    fit = ["--iterations", str(config.iterations), "--budget", config.limit]
    label = f"3/6 rebuilding the scene ({config.iterations} images)"
    step(output, label, ["rebuild", path, *fit], *beside)


def _record_trials(
    run: RunFolder,
    config: DemoConfig,
    endpoint: str,
    standin: list[str],
    missing: list[Trial],
    recorder: Background,
    output: Output,
) -> None:
    connect, logs = ["--connect", endpoint], run.notes_dir / "logs"
    left = [(each, len(set(missing) & set(each.trials(config)))) for each in groups_of(config)]
    with ExitStack() as stack:
        watch = running(
            ["gate", str(run.path), "--samples", "0", *connect], logs / "gate.log", "ready"
        )
        gate = stack.enter_context(watch)
        there = [recorder, gate]
        if any(count and group.policy != BUILT_IN_POLICY for group, count in left):
            live = ["plan", str(run.path), "--live", *connect]
            planner = stack.enter_context(running(live, logs / "plan.log", "ready"))
            there.append(planner)
        for group, count in left:
            if not count:
                continue
            words = [*standin, "--task", group.chosen, "--trials", str(config.trials)]
            words += ["--no-scan", "--ask-always", "--missing", "--policy", group.policy]
            words += [word for each in group.conditions for word in ("--conditions", each)]
            if group.policy != BUILT_IN_POLICY:
                words += ["--planner", "wire"]
            how = "and with " if len(group.conditions) > 1 else ""
            label = (
                f"4/6 {count} trials of {Path(group.chosen).stem} by the policy {group.policy}, "
                f"{config.trials} starts without {how}replanning"
            )
            step(output, label, words, *there)


def _scene(run: RunFolder) -> Mapping[str, Any]:
    """What ``scene.json`` says; empty without a rebuilt scene."""
    try:
        return dict(json.loads((run.scene_dir / "scene.json").read_bytes()))
    except (OSError, ValueError):
        return {}


def _refuse_nothing(run: RunFolder) -> None:
    """Raise when the evaluation has no number of a replay."""
    results = json.loads((run.results_dir / "results.json").read_bytes())
    if not run.derived("*.replay.*"):
        found = "no replay was written"
    elif all(item["value"] is None for item in results["measurements"]):
        reasons = {item.get("reason_if_undefined") for item in results["measurements"]} - {None}
        found = "; ".join(sorted(reasons)) or "there is no measurement"
    else:
        return
    message = f"nothing was measured: {found}. See {run.results_dir / 'report.html'}."
    raise DashboardError(message)


def _command(arguments: list[str]) -> list[str]:
    return [sys.executable, "-m", "robot_gst", *arguments]


def step(
    output: Output, label: str, arguments: list[str], *needed: Background, show_result: bool = False
) -> None:
    """Run one command to its end; where it fails, what it needed may be the cause."""
    output.say(label)
    started = time.monotonic()
    quiet = ["--quiet"] if output.quiet else []
    stdout = None if show_result and not output.json else subprocess.DEVNULL
    process = start_command([*arguments, *quiet], stdout=stdout)
    try:
        with BEAT.doing(None):  # it speaks for itself
            code = process.wait()
    finally:
        stop_command(process)
    for background in needed:
        background.check()
    if code != 0:
        raise StepFailedError(command=f"robot-gst {' '.join(arguments)}", code=code, log=None)
    output.say(f"    {time.monotonic() - started:.0f} s: robot-gst {' '.join(arguments)}")


def start_command(
    arguments: list[str], *, env: Mapping[str, str] = os.environ, **options: Any
) -> subprocess.Popen[bytes]:
    """Start a command that Ctrl-C does not reach: it is told to end in its turn."""
    return subprocess.Popen(
        _command(arguments),
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        env=ending_with_me(env),
        **options,
    )


@contextmanager
def running(arguments: list[str], log: Path, words: str) -> Iterator[Background]:
    """Leave a command running while the context lasts, which begins when it has said something."""
    with ExitStack() as stack, log.open("wb") as stream:
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        process = start_command(arguments, stdout=stream, stderr=subprocess.STDOUT, env=environment)
        stack.callback(stop_command, process)
        started = Background(command=f"robot-gst {' '.join(arguments)}", process=process, log=log)
        started.wait_for(words)
        yield started


def free_port() -> int:
    """Return a port of the loopback address at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _close(
    run: RunFolder, config: DemoConfig, output: Output, seconds: float, void: dict[Path, str]
) -> None:
    """Say what there is now and what to look at next, and serve it where that was asked for."""
    path, fit = run.path, _scene(run).get("fit", {})
    summary = {
        "run": str(path),
        "seconds": round(seconds, 1),
        "episodes": len(run.episodes()),
        "replays": len(run.derived("*.replay.*")),
        "underfitted": bool(fit.get("underfitted")),
        "without_outcome": {episode.stem: why for episode, why in void.items()},
        "report": str(run.results_dir / "report.html"),
    }
    lines = [
        f"\nDone in {seconds:.0f} s: {summary['episodes']} episodes, {summary['replays']} replays. "
        "All of it is from the stand-in cell, none of it is a real robot."
    ]
    if summary["underfitted"]:
        lines.append(
            f"The scene is underfitted: its time limit struck after {fit['iterations']} of "
            f"{config.iterations} images, so its renders are worse than they could be."
        )
    lines += [f"{episode.stem} has no outcome: {why}." for episode, why in void.items()]
    if config.trials < ENOUGH_TRIALS:
        lines += [
            f"A group has {config.trials} trials, so the correlation says nothing yet:",
            f"  {ENOUGH_TRIALS} in each are needed (robot-gst trials RUN).",
        ]
    lines += [
        "Look at next:",
        f"  {summary['report']}",
        "      success table and agreement in one file",
        f"  robot-gst ls {path}",
        "      what was recorded",
        f"  robot-gst view {path}",
        "      the newest trial and the rebuilt scene in Rerun",
        f"  robot-gst dashboard {path}",
        "      review pages",
        how_to_activate(),
    ]
    output.result(summary, "\n".join(lines))
    serve = sys.stdout.isatty() if config.serve is None else config.serve
    if serve:
        os.execv(  # the dashboard takes this process over, so Ctrl-C reaches it directly
            sys.executable, _command(["dashboard", str(path), "--port", str(config.port)])
        )
