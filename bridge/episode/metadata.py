"""Metadata records of an episode: who, what, how it ended, and where a derived one came from.

MCAP metadata maps strings to strings; every value here is stored as JSON text so that types
survive the round trip.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import msgspec

from bridge.task.verdict import SAME_ENGINE, is_same_engine

SCHEMA_VERSION = 1
RETRY = "retry"
"""A new start after an execution that failed: labelled, shown apart, in no rate of trials."""
KINDS = ("scan", "trial", RETRY, "probe", "imported")
NOTHING_EXECUTED = "nothing executed"
"""How the label of a trial begins in which no plan was sent to the robot."""
WITHOUT, WITH = "without_replanning", "with_replanning"
"""The two conditions of a trial that evaluation compares."""
CONDITION_OF = {"without": WITHOUT, "with": WITH, "control": WITHOUT}


@dataclass(frozen=True, kw_only=True)
class EpisodeInfo:
    """The ``episode`` metadata record."""

    id: str
    kind: str
    """One of scan, trial, retry, probe, imported."""
    task: str = ""
    task_sha256: str = ""
    """Of the task file it was recorded with, which is attached; empty: not known."""
    instruction: str = ""
    condition: str = ""
    """without_replanning or with_replanning."""
    policy: str = ""
    trial: int | None = None
    start_id: str | None = None
    start_seed: int | None = None
    operator: str = ""
    robot: str = ""
    cell: str = ""
    stand_in: bool = False
    tags: tuple[str, ...] = ()
    schema_version: int = SCHEMA_VERSION

    @property
    def study_arm(self) -> str:
        """The study arm of a trial; empty outside a study."""
        return study_arm_of(self.tags)

    @property
    def checkpoint(self) -> str:
        """Which weights acted under the policy's name; empty where nobody said so."""
        return tagged(self.tags, CHECKPOINT_TAG)


def imported_info(episode_id: str, task: str, **more: Any) -> EpisodeInfo:
    """Describe an imported episode; with the name of a task it is a trial like any other."""
    return EpisodeInfo(id=episode_id, kind="trial" if task else "imported", task=task, **more)


RETRY_OF_TAG = "retry_of:"
STUDY_ARM_TAG = "study_arm:"
CHECKPOINT_TAG = "checkpoint:"


def tagged(tags: Iterable[str], prefix: str) -> str:
    """Return what the first tag that begins so goes on with; empty where there is none."""
    return next((tag for tag in tags if tag.startswith(prefix)), "").removeprefix(prefix)


def study_arm_of(tags: Iterable[str]) -> str:
    """Read the study arm from an episode's tags; empty outside a study."""
    return tagged(tags, STUDY_ARM_TAG)


CONTROL = "control"


def treatment_of(condition: str, study_arm: str) -> str:
    """What trials are grouped by: the condition, but for a study's control, a group of its own."""
    return CONTROL if study_arm == CONTROL else condition


def retried_trial(info: EpisodeInfo) -> str:
    """Id of the trial that a retry follows; empty where it does not say."""
    return tagged(info.tags, RETRY_OF_TAG)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The ``outcome`` metadata record: what the operator says happened."""

    result: str
    """success, failure or unknown."""
    unit: str = "trial"
    k: int = 0
    n: int = 1
    by: str = "operator"
    detail: str | None = None
    stages: tuple[dict[str, Any], ...] = ()
    schema_version: int = SCHEMA_VERSION

    @property
    def is_failed_execution(self) -> bool:
        """Whether something was executed, stage by stage, and did not do the task."""
        return self.result == "failure" and bool(self.stages)


BY_DISK = "disk: "
"""How ``stopped_by`` in the record ``recorder`` begins where a disk refused what came."""
IN_RESERVE = "disk reserve: "
"""The same where a recording was ended while the disk still took everything."""
SECOND_ENGINE_KEY = "second_engine"
"""Among the settings of a replay that an earlier edition made beside the one that decides: shown,
never counted."""
ROLLOUT = "rollout"
"""Kind of a derived episode in which a policy acted in the twin, and where its row lies."""


@dataclass(frozen=True, kw_only=True)
class Derived:
    """The ``derived`` metadata record: what the twin made this episode from."""

    kind: str
    """replay, localised or views."""
    source_episode: str
    source_sha256: str
    plan_id: str | None = None
    trajectory: str | None = None
    """planned or executed."""
    mode: str | None = None
    """kinematic or dynamic."""
    scene_hash: str | None = None
    engine: str | None = None
    seed: int | None = None
    calibration_id: str | None = None
    settings: dict[str, Any] = field(default_factory=dict)


def why_not_counted(derived: Derived, *, stand_in: bool) -> str:
    """Why a replay never enters a number, whatever it says; empty where it may."""
    if is_same_engine(derived.engine, stand_in=stand_in):
        return f"made in {derived.engine}, the {SAME_ENGINE}"
    if derived.settings.get(SECOND_ENGINE_KEY):
        return f"made in {derived.engine}, beside the engine that decides"
    return ""


Record = TypeVar("Record")


def to_strings(record: object) -> dict[str, str]:
    """Turn one of the records above, or a map of values, into an MCAP metadata map."""
    values = msgspec.to_builtins(record).items()
    return {name: json.dumps(value) for name, value in values}


def build(of_type: type[Record], record: Mapping[str, Any]) -> Record:
    """Make one of the records above from parsed values; fields of later versions are left out.

    Raises:
        ValueError: When a field is missing, or is a list, text or number and should not be.
    """
    return msgspec.convert(record, of_type)


def from_strings(values: dict[str, str]) -> dict[str, Any]:
    """Read an MCAP metadata map; plain text that is not JSON is kept as it is."""
    return {name: _loaded(text) for name, text in values.items()}


def _loaded(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text
