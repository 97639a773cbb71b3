"""gst protocol v1: what a study will do, written into its run before the first trial.

Whoever reads the results can see that arms, rounds, coins, starts and the rule for stopping were
not chosen afterwards.
"""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bridge.errors import UsageError
from bridge.task.record import check_record, parse_record
from bridge.whole_file import write_whole

SCHEMA_VERSION = 1
FILE_NAME = "protocol.json"
"""In the run folder."""
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
    stopping: str = "fixed"
    """fixed: after all starts of every task; nobody looks before."""
    retry: bool = False
    """Whether each failed execution is followed by one new start of the same trial."""
    void_causes: tuple[str, ...] = VOID_CAUSES
    """How outcomes begin that make a start void in all arms; all others are failures."""

    def to_json(self) -> bytes:
        """Serialise, refusing what the schema refuses."""
        record = json.loads(json.dumps({"schema_version": SCHEMA_VERSION, **asdict(self)}))
        check_record(record, name="protocol")
        return (json.dumps(record, indent=1) + "\n").encode()

    @staticmethod
    def from_json(data: bytes) -> "Protocol":
        """Parse and check. Raises ``InvalidRecordError`` naming what does not fit."""
        record = parse_record(data, name="protocol")
        known = {name: record[name] for name in Protocol.__dataclass_fields__ if name in record}
        known["tasks"] = tuple(StudyTask(**_known(StudyTask, item)) for item in record["tasks"])
        known["policies"] = tuple(
            PolicyArms(policy=item["policy"], arms=tuple(item["arms"]))
            for item in record["policies"]
        )
        if "void_causes" in record:
            known["void_causes"] = tuple(record["void_causes"])
        return Protocol(**known)


def _known(of_type: type[StudyTask], record: dict[str, Any]) -> dict[str, Any]:
    return {name: record[name] for name in of_type.__dataclass_fields__ if name in record}


def read_protocol(run_path: Path) -> Protocol | None:
    """Return a run's protocol, None where it has none.

    Raises:
        InvalidRecordError: When there is one that does not fit its schema.
    """
    path = run_path / FILE_NAME
    return Protocol.from_json(path.read_bytes()) if path.is_file() else None


def keep_protocol(run_path: Path, protocol: Protocol, *, has_trials: bool) -> None:
    """Write a protocol before the first trial, or check that it is the one that was written.

    Args:
        run_path: The run folder.
        protocol: What the study will do.
        has_trials: Whether the run holds trials already.

    Raises:
        UsageError: When another protocol is there, or trials are and none is.
    """
    there = read_protocol(run_path)
    if there == protocol:
        return
    if there is not None:
        names = [
            name
            for name in Protocol.__dataclass_fields__
            if getattr(there, name) != getattr(protocol, name)
        ]
        message = (
            f"{run_path / FILE_NAME} was written before the first trial and says something else "
            f"about: {', '.join(names)}. Give the same options again, or another folder."
        )
        raise UsageError(message)
    if has_trials:
        message = f"{run_path} holds trials and no {FILE_NAME}: use a new folder for a study."
        raise UsageError(message)
    write_whole(run_path / FILE_NAME, protocol.to_json())


def with_coins(protocol: Protocol, coins: dict[str, float], coin_from: str) -> Protocol:
    """Fix the chance of yes for each task.

    Args:
        protocol: Whose tasks get them.
        coins: By name of the task.
        coin_from: Where they are from, in words.
    """
    tasks = tuple(replace(each, coin=coins.get(each.task)) for each in protocol.tasks)
    return replace(protocol, tasks=tasks, coin_from=coin_from)
