"""gst protocol v1: what a study will do, written into its run before the first trial.

Whoever reads the results can see that arms, rounds, coins, starts and the rule for stopping were
not chosen afterwards.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from bridge.task.record import check_record, made_of, parse_record

Item = TypeVar("Item")

SCHEMA_VERSION = 1
FILE_NAME = "protocol.json"
SEEDS_PER_SESSION = 1000
"""Session 7 starts at start seed 7000; sessions never share a start."""
STARTS_STREAM, ARMS_STREAM = 808, 606
VOID_CAUSES = ("interrupted",)
"""What makes a trial void, and its start in all arms, unless a protocol says otherwise."""


@dataclass(frozen=True, kw_only=True)
class PolicyArms:
    """In which arms a policy is tried."""

    policy: str
    arms: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class StudyTask:
    """One task of a study, and its starts."""

    task: str
    task_sha256: str
    session_seed: int
    """Draws the laboratory and, with the number of each, the starts."""
    starts: int
    coin: float | None = None
    """In the arm control, the chance of yes to each plan."""
    first_start: int = 0
    """Number of its first start in the session; the others follow it."""

    def start_seed(self, start: int) -> int:
        """Return the seed of a start, counted from 0 for the first of the study."""
        return self.session_seed * SEEDS_PER_SESSION + self.first_start + start

    def start_id(self, start: int) -> str:
        """Return the name under which the trials of a start are recorded."""
        return f"{self.task}/{self.start_seed(start)}"


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """A question that the study answers, and what answers it."""

    kind: str
    """difference: success of one arm less that of another, compared while the study goes on.
    agreement: the share of trials in which twin and outcome agree, its interval above ``limit``."""
    policy: str
    arm: str
    against_policy: str = ""
    against_arm: str = ""
    limit: float = 0.0
    """A difference is tested against none; an agreement has to lie above this share."""

    @property
    def words(self) -> str:
        """The question in words."""
        mine = f"{self.policy} ({self.arm})"
        if self.kind == "agreement":
            return f"twin and outcome agree in more than {100 * self.limit:g} %, {mine}"
        return f"success of {mine} less that of {self.against_policy} ({self.against_arm})"


@dataclass(frozen=True, kw_only=True)
class PlannedTrial:
    """One trial of the order in which a study is to be carried out."""

    number: int
    """From 1."""
    task: str
    start_id: str
    policy: str
    arm: str


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """What a study will do."""

    tasks: tuple[StudyTask, ...]
    policies: tuple[PolicyArms, ...]
    rounds: int
    """K: plans per trial in the arms with and control."""
    study_seed: int
    """Draws the order of the arms on each start, and the coins."""
    coin_from: str = ""
    """Where the coins' chances are from, in words."""
    calibration_sha256: str = ""
    """Of the calibration.json that gate and replays use, learned in a run of other starts; empty:
    the study takes none over."""
    calibration_from: str = ""
    """Which run that is and what it learned from, in words."""
    model_name: str = ""
    """Of the vision-language model that policy ``model`` asks; empty: none is asked."""
    model_address: str = ""
    """Of its server, without user and query."""
    stopping: str = "fixed"
    """fixed: after all starts of every task. sequential: at the first look that decides."""
    retry: bool = False
    """Whether each failed execution is followed by one new start of the same trial."""
    void_causes: tuple[str, ...] = VOID_CAUSES
    """How outcomes begin that make a start void in all arms; all others are failures."""
    primary: Endpoint | None = None
    """The one question the study is judged by; None where it was not designed."""
    secondary: tuple[Endpoint, ...] = ()
    interval: str = "wilson"
    alpha: float = 0.05
    """Chance of a false alarm, shared by all questions after Holm."""
    codes: Mapping[str, str] = field(default_factory=dict)
    """Blinded arms: a code for each "policy, arm"; empty where nobody is blinded."""
    reasons: tuple[str, ...] = ()
    """How the numbers of starts came about, in words."""
    sha256: str = field(default="", compare=False)
    """Of all else in the file it was read from; empty in files older than the hash."""
    edited: bool = field(default=False, compare=False)
    """Whether the file was changed after it was written: the hash does not fit."""

    def to_json(self) -> bytes:
        """Serialise with the hash of the content, refusing what the schema refuses."""
        written = asdict(self)
        del written["edited"], written["sha256"]
        record = json.loads(json.dumps({"schema_version": SCHEMA_VERSION, **written}))
        record["sha256"] = _hash(record)
        check_record(record, name="protocol")
        return (json.dumps(record, indent=1) + "\n").encode()

    def starts(self) -> list[tuple[StudyTask, int]]:
        """Return every start of every task, interleaved in a seeded order."""
        all_ = [(task, start) for task in self.tasks for start in range(task.starts)]
        return _shuffled(all_, STARTS_STREAM, self.study_seed)

    def policies_at(self, task: StudyTask, start: int) -> list[PolicyArms]:
        """Return the policies in the order in which they try one start."""
        seeds = self.study_seed, task.start_seed(start)
        return _shuffled(self.policies, STARTS_STREAM, *seeds)

    def order(self) -> list[PlannedTrial]:
        """Return all trials as they are to be made: each start in all arms, one after another."""
        found: list[PlannedTrial] = []
        for task, start in self.starts():
            for policy in self.policies_at(task, start):
                for arm in arms_in_order(policy.arms, self.study_seed, task.start_seed(start)):
                    found.append(
                        PlannedTrial(
                            number=len(found) + 1,
                            task=task.task,
                            start_id=task.start_id(start),
                            policy=policy.policy,
                            arm=arm,
                        )
                    )
        return found

    def code_of(self, policy: str, arm: str) -> str:
        """Return what an operator calls an arm; empty where nobody is blinded."""
        return self.codes.get(f"{policy}, {arm}", "")

    @staticmethod
    def from_json(data: bytes) -> "Protocol":
        """Parse and check. Raises ``InvalidRecordError`` naming what does not fit."""
        record = parse_record(data, name="protocol")
        edited = record.get("sha256", "") not in ("", _hash(record))
        return replace(made_of(Protocol, record, name="protocol"), edited=edited)


def arms_in_order(arms: Sequence[str], study_seed: int, start_seed: int) -> list[str]:
    """Return the arms in the order in which they are tried on one start."""
    return _shuffled(arms, ARMS_STREAM, study_seed, start_seed)


def blinding_codes(policies: Sequence[PolicyArms], study_seed: int) -> dict[str, str]:
    """Return a code for each "policy, arm", in an order that the seed draws."""
    names = [f"{policy.policy}, {arm}" for policy in policies for arm in policy.arms]
    drawn = _shuffled(names, STARTS_STREAM, study_seed, len(names))
    return {name: f"arm_{place:02d}" for place, name in enumerate(drawn, start=1)}


def _shuffled(items: Sequence[Item], *seed: int) -> list[Item]:
    import numpy as np  # noqa: PLC0415  # commands read their options without it

    order = np.random.default_rng(list(seed)).permutation(len(items))
    return [items[index] for index in order]


def _hash(record: Mapping[str, Any]) -> str:
    """Hash everything in a record but its hash, however the file is laid out."""
    others = {name: value for name, value in record.items() if name != "sha256"}
    text = json.dumps(others, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def read_protocol(run_path: Path) -> Protocol | None:
    """Return a run's protocol, None where it has none."""
    path = run_path / FILE_NAME
    return Protocol.from_json(path.read_bytes()) if path.is_file() else None


def with_coins(protocol: Protocol, coins: dict[str, float], coin_from: str) -> Protocol:
    """Fix the chance of yes for each task."""
    tasks = tuple(replace(each, coin=coins.get(each.task)) for each in protocol.tasks)
    return replace(protocol, tasks=tasks, coin_from=coin_from)
