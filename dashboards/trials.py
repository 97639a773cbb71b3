"""A study: policies on the same starts, in every study arm, by the real commands.

Each start is one job that a stand-in cell of its own does, with recorder, gate and planner as
separate processes. What comes out of a job follows from its seeds alone, so order, interruptions
and the number of workers change nothing. A start that was interrupted is begun anew in all arms.
"""

import os
import queue
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.data_files import datasets_folder
from bridge.episode.catalogue import outcome_of
from bridge.episode.mcap.part_file import lock_dead
from bridge.episode.metadata import CONDITION_OF, RETRY, retried_trial
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder, refuse_full
from bridge.episode.streams import verdicts
from bridge.errors import GstError, UsageError
from bridge.process_pool import cores
from bridge.task.find import chosen_task_file
from bridge.task.model_policy import server_of
from bridge.task.plan import STUDY_ARMS
from bridge.task.protocol import (
    FILE_NAME,
    SEEDS_PER_SESSION,
    PolicyArms,
    Protocol,
    StudyTask,
    read_protocol,
    with_coins,
)
from bridge.terminal import Output
from bridge.whole_file import write_whole
from dashboards.demo import (
    RECORDER_READY,
    Background,
    StepFailedError,
    cut_short,
    ending_on_signals,
    free_port,
    running,
    scan_task,
    set_aside,
    start_command,
    step,
    stop_command,
)
from dashboards.standin_settings import BUILT_IN_POLICY, TrialsConfig

EVERY_TASK = "all"
CELL = "standin"
POLL_S = 0.2


@dataclass(frozen=True, kw_only=True)
class Job:
    """One start of one task under one policy, in all its arms."""

    number: int
    """Of the job; its episodes are numbered by it."""
    task: str
    chosen: str
    """The task as it was asked for: its name or its file."""
    policy: str
    arms: tuple[str, ...]
    session_seed: int
    start: int
    """Its number in the session."""
    coin: float | None

    @property
    def start_seed(self) -> int:
        """Of its start."""
        return self.session_seed * SEEDS_PER_SESSION + self.start

    @property
    def key(self) -> tuple[str, str, int]:
        """What tells it from others."""
        return self.task, self.policy, self.start_seed

    @property
    def first_trial(self) -> int:
        """Number of its first episode."""
        return 1 + self.number * len(STUDY_ARMS)


def run_trials(path: Path, config: TrialsConfig, output: Output) -> int:
    """Write the protocol, do every job that is not done, replay and evaluate."""
    protocol, chosen = protocol_of(config)
    learned = None
    if config.calibration is not None:
        from dashboards.learned import learned_in  # noqa: PLC0415  # reads robots, a second

        learned = learned_in(RunFolder.open(config.calibration), protocol)
        protocol = learned.named_in(protocol)
    run = RunFolder.create(path)
    refuse_full(run.path)
    jobs = jobs_of(protocol, chosen)
    with ending_on_signals():
        keep_protocol(run.path, protocol, has_trials=bool(run.episodes()))
        if learned is not None:
            learned.put_into(run)
        left = _clear(run, jobs, output, retry=config.retry)
        if left:
            _scan(run, config, left, output)
            _do(run, config, left, output)
        if config.acting():
            roll_out(path, config, output)
        step(
            output, "replaying every plan", ["replay", str(path), "--samples", f"{config.samples}"]
        )
        step(output, "evaluating", ["evaluate", str(path)], show_result=True)
    return 0


def acting_command(run: Path, config: TrialsConfig, policy: str) -> list[str]:
    """The command that lets a policy act."""
    words = ["rollout", str(run), "--policy", config.acting()[policy], "--name", policy]
    return words if config.map is None else [*words, "--map", str(config.map)]


def roll_out(run: Path, config: TrialsConfig, output: Output) -> None:
    """Rebuild the scene where there is none, and let those who acted in the cell act in it."""
    if not (run / "scene" / "scene.json").is_file():
        step(output, "rebuilding the scene", ["rebuild", str(run), "--iterations", "3000"])
    for policy in config.acting():
        try:
            step(output, f"rolling {policy} out in the twin", acting_command(run, config, policy))
        except StepFailedError as error:  # 2: some say nothing of it, which was printed
            if error.code != 2:
                raise


def protocol_of(config: TrialsConfig) -> tuple[Protocol, dict[str, str]]:
    """What the study will do, and by name how each of its tasks was asked for."""
    names = list(config.task)
    if EVERY_TASK in names:
        names = sorted(each.stem for each in (datasets_folder() / "tasks").glob("*.toml"))
    files = {name: chosen_task_file(name) for name in names}
    chosen = {file.task().name: name for name, file in files.items()}
    for arm in config.arms:
        if arm not in CONDITION_OF:
            raise UsageError(f"--arms {arm!r} is unknown. There are: {', '.join(STUDY_ARMS)}.")
    tasks = tuple(
        StudyTask(
            task=file.task().name,
            task_sha256=file.sha256,
            session_seed=config.seed,
            starts=config.trials,
            first_start=config.first_start,
        )
        for file in files.values()
    )
    first, *others = dict.fromkeys(each.split("=", 1)[0] for each in config.policies)
    policies = (
        PolicyArms(policy=first, arms=("without",) if first in config.acting() else config.arms),
        *(PolicyArms(policy=each, arms=("without",)) for each in others),
    )
    if config.model:
        server_of(config.model)  # refuses secrets in the address
    protocol = Protocol(
        tasks=tasks,
        policies=policies,
        model_name=config.model_name,
        model_address=config.model,
        rounds=config.rounds,
        study_seed=config.study_seed,
        retry=config.retry,
    )
    if "control" not in config.arms:
        return protocol, chosen
    return _with_coins(protocol, config), chosen


def _with_coins(protocol: Protocol, config: TrialsConfig) -> Protocol:
    names = [each.task for each in protocol.tasks]
    if config.coin is not None:
        return with_coins(protocol, dict.fromkeys(names, config.coin), "given by --coin")
    if config.development is None:
        raise UsageError(
            "the arm control needs the chance of yes to each plan: --coin, or --development RUN "
            "with a run of development seeds."
        )
    shares = yes_shares(RunFolder.open(config.development))
    if missing := [name for name in names if name not in shares]:
        raise UsageError(
            f"the gate judged no plan of {', '.join(missing)} in {config.development}: record "
            "some there, or give --coin."
        )
    words = ", ".join(f"{name} {k} of {n}" for name, (k, n) in sorted(shares.items()))
    coins = {name: round(k / n, 6) for name, (k, n) in shares.items()}
    return with_coins(protocol, coins, f"the gate's share of yes on development seeds: {words}")


def yes_shares(run: RunFolder) -> dict[str, tuple[int, int]]:
    """By task: plans that the gate accepted, and those that it decided, in a run's recordings."""
    counts: dict[str, tuple[int, int]] = {}
    for path in run.episodes():
        episode = Episode.open(path)
        if episode.info.kind != "trial":
            continue
        for _, verdict in verdicts(episode):
            if verdict.accepted is not None and verdict.trajectory == "planned":
                k, n = counts.get(episode.info.task, (0, 0))
                counts[episode.info.task] = (k + int(verdict.accepted), n + 1)
    return counts


def jobs_of(protocol: Protocol, chosen: dict[str, str]) -> list[Job]:
    """Every start under every policy, numbered in the protocol's order."""
    jobs: list[Job] = []
    for task in protocol.tasks:
        for policy in protocol.policies:
            for start in range(task.starts):
                jobs.append(
                    Job(
                        number=len(jobs),
                        task=task.task,
                        chosen=chosen[task.task],
                        policy=policy.policy,
                        arms=policy.arms,
                        session_seed=task.session_seed,
                        start=task.first_start + start,
                        coin=task.coin if "control" in policy.arms else None,
                    )
                )
    by_key = {job.key: job for job in jobs}
    return [
        by_key[task.task, policy.policy, task.start_seed(start)]
        for task, start in protocol.starts()
        for policy in protocol.policies_at(task, start)
    ]


@dataclass(frozen=True, kw_only=True)
class _There:
    """What a run holds of a study already, by job."""

    trials: dict[tuple[str, str, int], dict[str, Path]]
    """By study arm."""
    broken: dict[tuple[str, str, int], list[Path]]
    retries: dict[str, Path]
    """By the id of the trial that failed."""
    failed: dict[tuple[str, str, int], set[str]]
    """Ids of trials whose execution failed."""

    def lacks(self, job: Job, *, retry: bool) -> bool:
        """Whether a start has to be tried, or tried anew."""
        unretried = self.failed.get(job.key, set()) - self.retries.keys() if retry else set()
        whole = set(self.trials[job.key]) == set(job.arms)
        return job.key in self.broken or not whole or bool(unretried)

    def files(self, job: Job) -> set[Path]:
        """Everything of a start."""
        trials = self.trials[job.key].values()
        followed = {self.retries[path.stem] for path in trials if path.stem in self.retries}
        return {*trials, *followed, *self.broken.get(job.key, [])}


def _clear(
    run: RunFolder, jobs: Sequence[Job], output: Output, *, retry: bool = False
) -> list[Job]:
    """Set aside every start that is there in part, and return the jobs that are to be done."""
    there = _there(run, jobs)
    left = [job for job in jobs if there.lacks(job, retry=retry)]
    for job in left:
        for path in there.files(job):
            set_aside(run, path, "its start was interrupted", output)
    return left


def _there(run: RunFolder, jobs: Sequence[Job]) -> _There:
    there = _There(trials={job.key: {} for job in jobs}, broken={}, retries={}, failed={})
    numbers = {job.first_trial + k: job.key for job in jobs for k in range(len(STUDY_ARMS))}
    for path in sorted(run.episodes_dir.glob("*.part")):
        descriptor = lock_dead(path)
        if descriptor is None:
            message = f"{path} is being written: another recorder works in {run.path}."
            raise UsageError(message)
        os.close(descriptor)
        key = numbers.get(_number(path))
        if key is not None:
            there.broken.setdefault(key, []).append(path)
    for path in run.episodes():
        try:
            episode = Episode.open(path)
            outcome = outcome_of(run, episode)
        except GstError:
            key = numbers.get(_number(path))
            if key is not None:
                there.broken.setdefault(key, []).append(path)
            continue
        info = episode.info
        key = (info.task, info.policy, info.start_seed or 0)
        if key not in there.trials:
            continue
        if cut_short(episode, outcome):
            there.broken.setdefault(key, []).append(path)
        if info.kind == RETRY:
            there.retries[retried_trial(info)] = path
            continue
        there.trials[key][info.study_arm] = path
        if outcome is not None and outcome.is_failed_execution:
            there.failed.setdefault(key, set()).add(info.id)
    return there


def _number(path: Path) -> int:
    digits = path.name.split(".")[0].rpartition("_")[2]
    return int(digits) if digits.isdigit() else -1


def _scan(run: RunFolder, config: TrialsConfig, jobs: Sequence[Job], output: Output) -> None:
    """Record a scan of each task that has none, before its first trial."""
    there = set()
    for path in run.episodes():
        with suppress(GstError):
            episode = Episode.open(path)
            if episode.info.kind == "scan" and not cut_short(episode, episode.outcome):
                there.add(episode.info.task)
    wanted = {job.task: job for job in reversed(jobs) if job.task not in there}
    if not wanted:
        return
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    log = run.notes_dir / "logs" / "record_scans.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    with running(["record", str(run.path), "--listen", endpoint], log, RECORDER_READY) as recorder:
        for job in wanted.values():
            standin = ["publish", "standin", "--connect", endpoint]
            standin += ["--seed", str(job.session_seed), "--first-start", str(job.start)]
            scan_task(job.chosen, standin, output, recorder)


def _do(run: RunFolder, config: TrialsConfig, jobs: Sequence[Job], output: Output) -> None:
    """Let as many cells work at once as there are cores, each start with one of them."""
    left: queue.SimpleQueue[Job] = queue.SimpleQueue()
    for job in jobs:
        left.put(job)
    workers = min(config.workers or cores(), len(jobs))
    stop, failures = threading.Event(), list[BaseException]()
    done = 0
    counting = threading.Lock()
    output.say(f"{len(jobs)} starts to try, {workers} at a time")
    with output.progress("starts", len(jobs)) as advance:

        def work(index: int) -> None:
            nonlocal done
            try:
                with _laboratory(run, config, jobs, index) as (endpoint, background):
                    while not stop.is_set() and (job := _next(left)) is not None:
                        _try(job, config, endpoint, background, stop, run)
                        if stop.is_set():
                            break
                        with counting:
                            done += 1
                            advance(done, f"{job.task} {job.policy} start {job.start}")
            except BaseException as error:  # noqa: BLE001  # told by the thread that waits
                failures.append(error)
                stop.set()
            finally:
                ended.release()

        # Ctrl-C within Thread.join() makes Python take a running thread for ended.
        ended = threading.Semaphore(0)
        threads = [threading.Thread(target=work, args=(index,)) for index in range(workers)]
        running_threads = workers
        for thread in threads:
            thread.start()
        try:
            while running_threads:
                running_threads -= ended.acquire(timeout=POLL_S)
        finally:
            stop.set()
            while running_threads:
                running_threads -= ended.acquire(timeout=POLL_S)
    if failures:
        raise failures[0]


def _next(left: "queue.SimpleQueue[Job]") -> Job | None:
    try:
        return left.get_nowait()
    except queue.Empty:
        return None


@contextmanager
def _laboratory(
    run: RunFolder, config: TrialsConfig, jobs: Sequence[Job], index: int
) -> Iterator[tuple[str, list[Background]]]:
    """Recorder, gate and planner of one worker, on an endpoint of their own."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    logs = run.notes_dir / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    connect = ["--connect", endpoint]
    with ExitStack() as stack:
        there: list[Background] = []

        def start(name: str, arguments: list[str], words: str) -> None:
            log = logs / f"{name}_{index}.log"
            there.append(stack.enter_context(running(arguments, log, words)))

        own = ["--listen", endpoint, "--shares-folder"]  # each job numbers its own episodes
        start("record", ["record", str(run.path), *own], RECORDER_READY)
        start("gate", ["gate", str(run.path), "--samples", "0", *connect], "gate ready")
        if {job.policy for job in jobs} - {BUILT_IN_POLICY, *config.acting()}:
            model = ["--model", config.model, "--model-name", config.model_name]
            asking = model if config.model else []
            live = ["plan", str(run.path), "--live", *connect, *asking]
            start("plan", live, "planner ready")
        yield endpoint, there


def _try(
    job: Job,
    config: TrialsConfig,
    endpoint: str,
    background: Sequence[Background],
    stop: threading.Event,
    run: RunFolder,
) -> None:
    """Let a cell try one start in all its arms, unless it is told to stop."""
    arguments = command_of(job, config, endpoint)
    log = run.notes_dir / "logs" / f"start_{job.number:04d}.log"
    with ExitStack() as stack:
        if job.policy in config.acting():
            own = [*acting_command(run.path, config, job.policy), "--cell", CELL]
            own += ["--connect", endpoint]
            stack.enter_context(running(own, log.with_suffix(".policy.log"), "policy ready"))
        stream = stack.enter_context(log.open("wb"))
        process = start_command(arguments, stdout=stream, stderr=subprocess.STDOUT)
        try:
            while process.poll() is None and not stop.is_set():
                time.sleep(POLL_S / 4)
        finally:
            stop_command(process)
    for each in background:
        each.check()
    if process.returncode != 0 and not stop.is_set():
        command = f"robot-gst {' '.join(arguments)}"
        raise StepFailedError(command=command, code=process.returncode, log=log)


def command_of(job: Job, config: TrialsConfig, endpoint: str) -> list[str]:
    """The command that tries one start; its cell asks its own planner, who acts, or the wire."""
    asked = {BUILT_IN_POLICY: "built_in", **dict.fromkeys(config.acting(), "policy")}
    options: dict[str, Any] = {
        "--connect": endpoint,
        "--task": job.chosen,
        "--seed": job.session_seed,
        "--first-start": job.start,
        "--first-trial": job.first_trial,
        "--trials": 1,
        "--planner": asked.get(job.policy, "wire"),
        "--policy": job.policy,
        "--rounds": config.rounds,
        "--study-seed": config.study_seed,
    }
    if job.coin is not None:
        options["--coin"] = job.coin
    words = ["publish", "standin", "--no-scan"]
    for name, value in options.items():
        words += [name, str(value)]
    words += ["--retry"] if config.retry else []
    for arm in job.arms:
        words += ["--study-arms", arm]
    return words


CARRIED_OUT = (
    *("tasks", "policies", "rounds", "study_seed", "coin_from", "void_causes"),
    *("calibration_sha256", "calibration_from", "model_name", "model_address"),
)
"""What whoever carries a study out decides, too; the rest is the design's alone."""


def keep_protocol(run_path: Path, protocol: Protocol, *, has_trials: bool) -> None:
    """Write a protocol before the first trial, or check that it is the one that was written.

    A design that is there stays as it is, where what carries it out fits it.
    """
    path, there = run_path / FILE_NAME, read_protocol(run_path)
    if there is None and has_trials:
        message = f"{run_path} holds trials and no {FILE_NAME}: use a new folder for a study."
        raise UsageError(message)
    if there is None:
        write_whole(path, protocol.to_json())
        return
    if there.edited:
        raise UsageError(f"{path} was edited after it was written: put the written text back.")
    compared = CARRIED_OUT if protocol.primary is None else Protocol.__dataclass_fields__
    hidden = ("sha256", "edited")
    names = [
        name
        for name in compared
        if name not in hidden and getattr(there, name) != getattr(protocol, name)
    ]
    if names:
        raise UsageError(
            f"{path} was written before the first trial and says something else "
            f"about: {', '.join(names)}. Give the same options again, or another folder."
        )
