"""Read one recorded trial: which plan was sent, what the gate had said, how it ended."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import Outcome
from bridge.episode.reader import Episode
from bridge.episode.run import RunFolder
from bridge.episode.streams import localisations, pose_track
from bridge.errors import BridgeError
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.plan import Plan
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict
from evaluator.compare.clauses import clauses_of
from evaluator.compare.replays import DerivedFile, Replay, find_replay, localised_of
from evaluator.compare.rows import TcpErrorSeries, TrialRow
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import pose_errors
from evaluator.result import Exclusion

SAME_CLOCK_NS = 2 * NS_PER_S
"""A replay whose stamps start this close to the execution uses the cell's clock."""


@dataclass(kw_only=True)
class _Log:
    """What happened with plans, in the order it was received."""

    plan_ids: list[str] = field(default_factory=list)
    sent: list[str] = field(default_factory=list)
    started_ns: int | None = None
    ended_ns: int | None = None
    first_start_ns: dict[str, int] = field(default_factory=dict)
    """When each plan's first execution started, on the cell's clock."""
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    """The last verdict on each plan that was made before its execution started."""
    label: Outcome | None = None


def read_trial(
    run: RunFolder, episode: Episode, files: Sequence[DerivedFile], *, sha256: str
) -> tuple[TrialRow, list[Exclusion]]:
    """Build the row of one recorded trial, and list what it lacks.

    A label given after the fact (``robot-gst label``) overrides the one in the episode.

    Args:
        run: Where labels given afterwards lie.
        episode: The recorded trial.
        files: Every derived episode of the run.
        sha256: Content hash of the recorded episode; what was made from other bytes is stale.

    Raises:
        GstError: When the episode, or its label, is damaged.
    """
    log = _read_log(episode)
    outcome = outcome_of(run, episode) or log.label
    lacking = _unlabelled(outcome)
    planned = executed = Replay(file=None, verdict=None, reason=None)
    if not log.sent:
        lacking.append("no execution_started event: no plan was sent")
    else:
        planned, executed = (
            find_replay(
                files,
                source=episode.info.id,
                source_sha256=sha256,
                plan_id=log.sent[-1],
                trajectory=trajectory,
            )
            for trajectory in ("planned", "executed")
        )
        lacking += [] if planned.reason is None else [planned.reason]
    row = _row(episode, log, outcome, planned, executed)
    starts = [episode, *localised_of(files, source=episode.info.id, source_sha256=sha256)]
    row = replace(row, start_positions_m=_start_positions(starts, log.started_ns))
    return row, [
        Exclusion(episode=row.episode, scope="agreement", reason=reason) for reason in lacking
    ]


def _unlabelled(outcome: Outcome | None) -> list[str]:
    if outcome is None:
        return ["the outcome was not labelled"]
    if outcome.result == "unknown":
        why = f": {outcome.detail}" if outcome.detail else ""
        return [f"the outcome is labelled unknown{why}"]
    return []


def _row(
    episode: Episode, log: _Log, outcome: Outcome | None, planned: Replay, executed: Replay
) -> TrialRow:
    info = episode.info
    verdict = log.verdicts.get(log.sent[-1]) if log.sent else None
    failing = planned.verdict if planned.verdict is not None else verdict
    result = None if outcome is None else outcome.result
    counted = outcome is not None and outcome.unit != "trial"
    return TrialRow(
        episode=info.id,
        task=info.task,
        condition=info.condition,
        policy=info.policy,
        start_id=info.start_id,
        cell=info.cell,
        stand_in=info.stand_in,
        recorded={"success": True, "failure": False}.get(result or ""),
        unit="trial" if outcome is None else outcome.unit,
        k=outcome.k if outcome is not None and counted else None,
        n=outcome.n if outcome is not None and counted else None,
        plan_id=log.sent[-1] if log.sent else None,
        num_plans=len(set(log.plan_ids)),
        num_plans_sent=len(set(log.sent)),
        sim_planned=planned.accepted,
        sim_executed=executed.accepted,
        verdict=None if verdict is None else verdict.accepted,
        p_success=_p_success(planned.verdict, verdict),
        first_failing=None if failing is None else failing.first_failing,
        failing_detail=_failing_detail(failing),
        failing_cause=_failing_cause(failing),
        stages=_stages(outcome),
        clauses=clauses_of(planned.verdict),
        gate_clauses=clauses_of(verdict),
        planned_replay=None if planned.file is None else planned.file.path.name,
        executed_replay=None if executed.file is None else executed.file.path.name,
        path=episode.path,
        tcp_errors=_tcp_errors(episode, log, planned, executed),
    )


def _read_log(episode: Episode) -> _Log:
    log = _Log()
    topics = [
        topic
        for name in (schema.PLAN, schema.EVENT, schema.VERDICT)
        for topic in episode.topics_of_type(name)
    ]
    for message in episode.messages(topics):
        if message.type_name == schema.PLAN:
            log.plan_ids.append(Plan.from_json(message.data).id)
        elif message.type_name == schema.VERDICT:
            said = Verdict.from_json(message.data)
            # It may arrive late over its own connection; its stamp is the cell's time.
            started_ns = log.first_start_ns.get(said.plan_id)
            in_time = started_ns is None or message.publish_time_ns < started_ns
            if in_time and said.trajectory == "planned":
                log.verdicts[said.plan_id] = said
        else:
            _note_event(log, parse_record(message.data, name="event", package="bridge.episode"))
    return log


def _note_event(log: _Log, event: dict[str, object]) -> None:
    plan_id, stamp_ns = event.get("plan_id"), event.get("stamp_ns")
    if event["type"] == "execution_started" and isinstance(plan_id, str):
        log.sent.append(plan_id)
        log.started_ns, log.ended_ns = int(str(stamp_ns)), None
        log.first_start_ns.setdefault(plan_id, log.started_ns)
    elif event["type"] == "execution_ended" and log.sent and plan_id == log.sent[-1]:
        log.ended_ns = int(str(stamp_ns))
    elif event["type"] == "label":
        outcome = event.get("outcome")
        if isinstance(outcome, dict) and "result" in outcome:
            names = {"result", "unit", "k", "n", "by", "detail"}
            known = {key: outcome[key] for key in names & outcome.keys()}
            stages = outcome.get("stages") or ()
            log.label = Outcome(**known, stages=tuple(s for s in stages if isinstance(s, dict)))


def _p_success(*said: Verdict | None) -> float | None:
    for verdict in said:
        if verdict is not None and verdict.p_success is not None:
            return verdict.p_success.get("value")
    return None


def _failing_detail(verdict: Verdict | None) -> str | None:
    if verdict is None or verdict.first_failing is None:
        return None
    factor = getattr(verdict, verdict.first_failing)
    bodies = " and ".join(factor.bodies)
    parts = [factor.cause, bodies, factor.detail]
    if factor.first_t_ns is not None:
        parts.append(f"at {factor.first_t_ns / NS_PER_S:.2f} s")
    return ", ".join(part for part in parts if part) or None


def _failing_cause(verdict: Verdict | None) -> str | None:
    if verdict is None or verdict.first_failing is None:
        return None
    cause: str | None = getattr(verdict, verdict.first_failing).cause
    return cause


def _stages(outcome: Outcome | None) -> tuple[tuple[str, bool | None], ...]:
    answers = {"success": True, "failure": False}
    return tuple(
        (str(stage.get("id", "")), answers.get(str(stage.get("result"))))
        for stage in (outcome.stages if outcome is not None else ())
    )


def _start_positions(
    episodes: Sequence[Episode], started_ns: int | None
) -> dict[str, tuple[float, float, float]]:
    """Where objects were last localised before the start; later episodes overrule earlier ones."""
    found: dict[str, tuple[float, float, float]] = {}
    for record in (record for episode in episodes for record in localisations(episode)):
        pose = record.get("T_base_object")
        if not record["found"] or pose is None:
            continue
        if started_ns is None or record["stamp_ns"] <= started_ns:
            x, y, z = pose["p_m"]
            found[record["object"]] = (x, y, z)
    return found


def tcp_track(episode: Episode) -> PoseTrajectory | None:
    """Return the tool centre point's poses, or None where they were not recorded."""
    topics = [
        topic
        for topic in episode.topics_of_type(schema.POSE_STAMPED)
        if topic.endswith("/tcp/pose")
    ]
    try:
        return pose_track(episode, topics[0]) if topics else None
    except BridgeError:
        return None


def _tcp_errors(
    episode: Episode, log: _Log, planned: Replay, executed: Replay
) -> tuple[TcpErrorSeries, ...]:
    if log.started_ns is None or (planned.file is None and executed.file is None):
        return ()
    recorded = tcp_track(episode)
    if recorded is None:
        return ()
    recorded = _between(recorded, log.started_ns, log.ended_ns)
    series = []
    for against, replay in (("planned", planned), ("executed", executed)):
        track = None if replay.file is None else tcp_track(replay.file.episode)
        if track is None or len(recorded) == 0:
            continue
        if abs(int(track.stamps_ns[0]) - log.started_ns) > SAME_CLOCK_NS:
            shift_ns = log.started_ns - int(track.stamps_ns[0])
            track = PoseTrajectory(track.stamps_ns + shift_ns, track.p_m, track.q_wxyz)
        try:
            errors = pose_errors(recorded, track)
        except UndefinedStatisticError:
            continue
        series.append(
            TcpErrorSeries(
                against=against,
                t_s=(errors.stamps_ns - log.started_ns) / NS_PER_S,
                position_m=errors.position_m,
                rotation_rad=errors.rotation_rad,
            )
        )
    return tuple(series)


def _between(track: PoseTrajectory, first_ns: int, last_ns: int | None) -> PoseTrajectory:
    keep = track.stamps_ns >= first_ns
    if last_ns is not None:
        keep = np.logical_and(keep, track.stamps_ns <= last_ns)
    return PoseTrajectory(track.stamps_ns[keep], track.p_m[keep], track.q_wxyz[keep])
