"""Size a study, draw its order, and lock its protocol before the first trial."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bridge.episode.run_folder import RunFolder
from bridge.errors import PathNotFoundError, UsageError
from bridge.exchange.trials_csv import trials_path
from bridge.task import protocol as protocols
from bridge.task.find import chosen_task_file
from bridge.task.plan import STUDY_ARMS
from bridge.task.protocol import Endpoint, PolicyArms, Protocol, StudyTask
from bridge.whole_file import write_whole
from evaluator.compare.success import CONDITION_OF_ARM
from evaluator.design.config import StudyOptions, Wanted
from evaluator.errors import UndefinedStatisticError
from evaluator.statistics import sequential

ORDER_FILE = "order.csv"
"""In the run folder; with its outcomes filled in it is a trials CSV."""
NO_TASK_FILE = "0" * 64
"""Stands for the hash of a task that has no file."""


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What is expected of the arm compared with and of the other one."""

    rates: tuple[float, float]
    correlation: float

    @property
    def of_pair(self) -> sequential.Chances:
        """Chances of a pair of one start."""
        return sequential.chances(*self.rates, self.correlation)

    @property
    def words(self) -> str:
        """What is expected in words."""
        first, second = (f"{100 * rate:.0f} %" for rate in self.rates)
        told = f"expected rates: {first} and {second}; correlation of both outcomes of a start "
        return f"{told}{self.correlation:g}"


@dataclass(frozen=True, kw_only=True)
class Design:
    """A study, its size, and how that came about."""

    protocol: Protocol
    needed: int | None
    """Pairs that show the gain with the power that was asked for; None where no gain was given."""
    shows: tuple[str, ...]
    """What the study can show at its size."""
    expected: Expected


def design(study: StudyOptions, wanted: Wanted) -> Design:
    """Find the number of starts and everything else that a study fixes before its first trial.

    Raises:
        UsageError: When an option contradicts another, or nothing is asked for.
    """
    base = _protocol(study, wanted)
    expected = _expected(wanted)
    needed = None
    if expected.rates[0] != expected.rates[1]:
        try:
            needed = sequential.pairs_for_power(
                expected.of_pair, power=wanted.power, alpha=wanted.alpha
            )
        except UndefinedStatisticError as error:
            raise UsageError(f"{error} Expect a larger difference.") from error
    starts = wanted.starts or math.ceil((needed or 0) / len(base.tasks))
    if not starts:
        raise UsageError(
            "nothing says how large the study is to be: give --gain with --rate, or --starts."
        )
    if starts > 1000:
        raise UsageError(f"{starts} starts of each task would be needed; a study has 1000 at most.")
    tasks = tuple(replace(task, starts=starts) for task in base.tasks)
    shows = tuple(_shows(starts * len(tasks), wanted, expected))
    protocol = replace(base, tasks=tasks, reasons=(expected.words, *shows))
    return Design(protocol=protocol, needed=needed, shows=shows, expected=expected)


def _protocol(study: StudyOptions, wanted: Wanted) -> Protocol:
    """Lay out all but the number of starts."""
    for arm in study.arms:
        if arm not in STUDY_ARMS:
            raise UsageError(f"--arms {arm!r} is unknown. There are: {', '.join(STUDY_ARMS)}.")
    first, *others = list(dict.fromkeys(study.policies))
    policies = (
        PolicyArms(policy=first, arms=tuple(dict.fromkeys(study.arms))),
        *(PolicyArms(policy=each, arms=("without",)) for each in others),
    )
    primary, *secondary = _endpoints(policies)
    protocol = Protocol(
        tasks=tuple(_task(name, study) for name in dict.fromkeys(study.task)),
        policies=policies,
        rounds=study.rounds,
        study_seed=study.study_seed,
        stopping="sequential",
        primary=primary,
        secondary=tuple(secondary),
        alpha=wanted.alpha,
        codes=protocols.blinding_codes(policies, study.study_seed) if study.blind else {},
    )
    if "control" not in study.arms:
        return protocol
    if study.coin is None:
        raise UsageError("the arm control needs --coin, the chance of yes to each plan.")
    coins = {task.task: study.coin for task in protocol.tasks}
    return protocols.with_coins(protocol, coins, "given by --coin")


def _task(name: str, study: StudyOptions) -> StudyTask:
    sha256 = NO_TASK_FILE
    if not study.any_task or name.endswith(".toml"):
        file = chosen_task_file(name)
        name, sha256 = file.task().name, file.sha256
    return StudyTask(task=name, task_sha256=sha256, session_seed=study.seed, starts=1)


def _endpoints(policies: Sequence[PolicyArms]) -> list[Endpoint]:
    """List the questions, the primary one first."""
    first = policies[0]
    others = policies[1:] if "without" in first.arms else ()
    against = [arm for arm in ("without", "control") if {"with", arm} <= set(first.arms)]
    asked = [(first.policy, "with", arm) for arm in against]
    asked += [(other.policy, "without", "without") for other in others]
    if not asked:
        raise UsageError("there is nothing to compare: give two arms or two policies.")
    return [
        Endpoint(
            kind="difference",
            policy=policy,
            arm=arm,
            against_policy=first.policy,
            against_arm=against_arm,
        )
        for policy, arm, against_arm in asked
    ]


def _expected(wanted: Wanted) -> Expected:
    first = 0.5 if wanted.rate is None else wanted.rate
    second = first + (wanted.gain or 0.0)
    if not 0 <= second <= 1:
        raise UsageError(
            f"a rate of {100 * first:.0f} % and a gain of {100 * (second - first):.0f} points "
            f"make {100 * second:.0f} %: give another --rate or --gain."
        )
    return Expected(rates=(first, second), correlation=wanted.correlation)


def _shows(pairs: int, wanted: Wanted, expected: Expected) -> list[str]:
    """Say when a study of so many pairs is looked at, and how likely it is decided by then."""
    looks = sequential.look_pairs(pairs)
    listed = ", ".join(map(str, looks))
    found = [f"looked at after {listed} starts that all arms tried; it may stop at each"]
    if expected.rates[0] != expected.rates[1]:
        by = sequential.plan_power(pairs, expected.of_pair, alpha=wanted.alpha)
        each = ", ".join(
            f"{100 * chance:.0f} % by {n}" for n, chance in zip(looks, by, strict=True)
        )
        found.append(f"if the rates are as expected it is decided: {each}")
    return found


def lock(run_path: Path, made: Design) -> Protocol:
    """Write protocol, returned with its hash, and order into a run; never overwrite one.

    Raises:
        UsageError: When the run has a protocol or trials already.
    """
    path = run_path / protocols.FILE_NAME
    if path.exists():
        raise UsageError(
            f"{path} is locked: a study is designed once. Use another folder for another study."
        )
    run = RunFolder.create(run_path)
    if run.episodes() or trials_path(run).is_file():
        raise UsageError(f"{run_path} holds trials already: a study is designed before the first.")
    write_whole(run_path / ORDER_FILE, order_list(made.protocol))
    write_whole(path, made.protocol.to_json())
    written = protocols.read_protocol(run_path)
    if written is None:
        raise PathNotFoundError(path=path, what="protocol", hint="It was removed just now.")
    return written


def order_list(protocol: Protocol) -> bytes:
    """Lay out the order of the trials for the operator, as a trials CSV without outcomes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["trial_id", "task", "start_id", "policy", "condition", "recorded"])
    for trial in protocol.order():
        code = protocol.code_of(trial.policy, trial.arm)
        treatment = (code, "") if code else (trial.policy, CONDITION_OF_ARM[trial.arm])
        writer.writerow([f"trial_{trial.number:04d}", trial.task, trial.start_id, *treatment, ""])
    return text.getvalue().encode()


def design_text(made: Design, written: Protocol, run_path: Path) -> str:
    """Return the design in words."""
    protocol = made.protocol
    arms = sum(len(policy.arms) for policy in protocol.policies)
    starts, count = protocol.tasks[0].starts, len(protocol.tasks)
    tasks = "1 task" if count == 1 else f"{count} tasks"
    primary = "" if protocol.primary is None else protocol.primary.words
    lines = [
        f"Study of {tasks}, {arms} arms, {starts} starts of each task: "
        f"{len(protocol.order())} trials",
        f"Primary question: {primary}",
        *(f"Secondary: {each.words}" for each in protocol.secondary),
        *([] if made.needed is None else [f"Needed: {made.needed} starts over all tasks"]),
        *(f"At this size: {each}" for each in made.shows),
        made.expected.words.capitalize(),
        f"Locked: {run_path / protocols.FILE_NAME}, sha256 {written.sha256}",
        f"Order: {run_path / ORDER_FILE}, interleaved by --study-seed {protocol.study_seed}"
        + (", arms by code" if protocol.codes else ""),
        f"Then: fill in {ORDER_FILE}, robot-gst open {run_path / ORDER_FILE} "
        f"{run_path}, robot-gst evaluate {run_path}",
    ]
    return "\n".join(lines)


def design_record(made: Design, written: Protocol) -> dict[str, Any]:
    """Return the design for programs."""
    return {
        "starts": made.protocol.tasks[0].starts,
        "trials": len(made.protocol.order()),
        "needed": made.needed,
        "shows": list(made.shows),
        "sha256": written.sha256,
    }
