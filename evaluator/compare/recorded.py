"""Read what one recorded episode says: which plan was sent, what the gate had said, how it ended.

Only its metadata and its few messages about plans, events, verdicts and places are read; how the
arm moved is left to ``motion``.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from bridge.episode import schema
from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import EpisodeInfo, Outcome, build
from bridge.episode.reader import Episode, RawMessage
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.plan import SCHEMA_VERSION, Plan
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict
from evaluator.compare.said import Said, said_by

Position = tuple[float, float, float]
"""In the robot's base frame [m]."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where an object was localised."""

    object_id: str
    stamp_ns: int
    p_m: Position


@dataclass(frozen=True, kw_only=True)
class RecordedFacts:
    """What one recorded episode says of itself, with the label given to it afterwards."""

    info: EpisodeInfo
    began_ns: int = 0
    """When its recording began; 0 without messages."""
    outcome: Outcome | None = None
    """As the operator labelled it; a label given after the fact wins."""
    num_plans: int = 0
    num_plans_sent: int = 0
    plan_id: str | None = None
    """The plan actually sent: the last one whose execution started."""
    started_ns: int | None = None
    """When its execution started and ended, on the cell's clock."""
    ended_ns: int | None = None
    verdict: Said | None = None
    """The last verdict on that plan made before its execution started."""
    start_positions_m: dict[str, Position] = field(default_factory=dict)
    """Where objects were last localised before the start."""
    broken: str = ""
    """Why the trial cannot be judged, empty where it can."""


@dataclass(kw_only=True)
class _Log:
    """What happened with plans, in the order it was received."""

    plan_ids: set[str] = field(default_factory=set)
    sent: list[str] = field(default_factory=list)
    started_ns: int | None = None
    ended_ns: int | None = None
    first_start_ns: dict[str, int] = field(default_factory=dict)
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    label: Outcome | None = None
    localised: list[bytes] = field(default_factory=list)


def read_recorded(run: RunFolder, episode: Episode) -> RecordedFacts:
    """Sum up a recorded episode; of one that is no trial, only who and what.

    Raises:
        EpisodeError: When its metadata was written by another program and cannot be read.
    """
    info, outcome = episode.info, episode.outcome
    if info.kind != "trial":
        return RecordedFacts(info=info, outcome=outcome)
    try:
        return _read_trial(run, episode, info)
    except GstError as error:
        broken = str(error)
    except (OSError, TypeError, ValueError) as error:  # another program wrote it, or the disk
        broken = f"its label or messages cannot be read ({error})"
    return RecordedFacts(info=info, outcome=outcome, broken=broken)


def _read_trial(run: RunFolder, episode: Episode, info: EpisodeInfo) -> RecordedFacts:
    log = _read_log(episode)
    plan_id = log.sent[-1] if log.sent else None
    verdict = None if plan_id is None else log.verdicts.get(plan_id)
    return RecordedFacts(
        info=info,
        began_ns=episode.start_ns,
        outcome=outcome_of(run, episode) or log.label,
        num_plans=len(log.plan_ids),
        num_plans_sent=len(set(log.sent)),
        plan_id=plan_id,
        started_ns=log.started_ns,
        ended_ns=log.ended_ns,
        verdict=None if verdict is None else said_by(verdict),
        start_positions_m=positions_at_start(places_in(log.localised), log.started_ns),
    )


def places_in(localisations: Iterable[bytes]) -> list[Place]:
    """Return where objects were found, in log order.

    Raises:
        InvalidRecordError: When a record does not fit its schema.
    """
    places = []
    for data in localisations:
        record = parse_record(data, name="localisation")
        pose = record.get("T_base_object")
        if record["found"] and pose is not None:
            x, y, z = pose["p_m"]
            places.append(
                Place(object_id=record["object"], stamp_ns=record["stamp_ns"], p_m=(x, y, z))
            )
    return places


def positions_at_start(places: Iterable[Place], started_ns: int | None) -> dict[str, Position]:
    """Return the last place of each object that is not younger than the start."""
    return {
        place.object_id: place.p_m
        for place in places
        if started_ns is None or place.stamp_ns <= started_ns
    }


def _read_log(episode: Episode) -> _Log:
    log = _Log()
    topics = [
        topic
        for name in (schema.PLAN, schema.EVENT, schema.VERDICT, schema.LOCALISATION)
        for topic in episode.topics_of_type(name)
    ]
    for message in episode.messages(topics):
        if message.type_name == schema.PLAN:
            log.plan_ids.add(_plan_id(message.data))
        elif message.type_name == schema.VERDICT:
            _note_verdict(log, message)
        elif message.type_name == schema.LOCALISATION:
            log.localised.append(message.data)
        else:
            _note_event(log, parse_record(message.data, name="event", package="bridge.episode"))
    return log


def _plan_id(data: bytes) -> str:
    """Read a plan's id alone; checking hundreds of waypoints takes longer than all the rest."""
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        record = None
    if isinstance(record, dict) and record.get("schema_version") == SCHEMA_VERSION:
        plan_id = record.get("id")
        if isinstance(plan_id, str) and plan_id:
            return plan_id
    return Plan.from_json(data).id  # which says what is wrong


def _note_verdict(log: _Log, message: RawMessage) -> None:
    said = Verdict.from_json(message.data)
    # It may arrive late over its own connection; its stamp is the cell's time.
    started_ns = log.first_start_ns.get(said.plan_id)
    in_time = started_ns is None or message.publish_time_ns < started_ns
    if in_time and said.trajectory == "planned":
        log.verdicts[said.plan_id] = said


def _note_event(log: _Log, event: Mapping[str, Any]) -> None:
    plan_id = event.get("plan_id")
    if event["type"] == "execution_started" and isinstance(plan_id, str):
        log.sent.append(plan_id)
        log.started_ns, log.ended_ns = int(event["stamp_ns"]), None
        log.first_start_ns.setdefault(plan_id, log.started_ns)
    elif event["type"] == "execution_ended" and log.sent and plan_id == log.sent[-1]:
        log.ended_ns = int(event["stamp_ns"])
    elif event["type"] == "label":
        outcome = event.get("outcome")
        if isinstance(outcome, dict) and "result" in outcome:
            names = {"result", "unit", "k", "n", "by", "detail"}
            known = {key: outcome[key] for key in names & outcome.keys()}
            stages = [s for s in outcome.get("stages") or () if isinstance(s, dict)]
            log.label = build(Outcome, {**known, "stages": stages})
