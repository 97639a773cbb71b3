"""Operator's labels against the task's success predicate on the poses localised afterwards."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.clock import NS_PER_S
from bridge.episode import schema, streams
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.reader import Episode
from bridge.episode.topics import TCP_POSE
from bridge.geometry import se3
from bridge.task.predicate import PredicateResult, Rollout, all_hold, evaluate_success
from bridge.task.task_file import Task
from evaluator.compare.known_task import recorded_task
from evaluator.compare.measure import Part, proportion
from evaluator.compare.rows import TrialRow
from evaluator.measurements import LABEL_AGREED, LABEL_AGREED_OF_TASK
from evaluator.result import Cell, Exclusion, Measurement, Table

AFTER = "end"
DECIDED_BY_A_LOOK = ("inside", "on", "moved", "shape")
"""Clauses that one localisation decides. Whether something still moves, it cannot say."""
AWAY_M = 0.12
"""Fingers farther than this from an object's origin do not touch it."""
TAIL_NS = 2 * NS_PER_S
"""Read of a recording before all of it is."""


@dataclass(frozen=True, kw_only=True)
class PerceivedOutcome:
    """What the localised poses of one trial say of its success."""

    episode: str
    task: str
    condition: str
    plan_id: str
    says: bool | None
    """None when a clause about where or in which shape an object is stays open."""
    detail: str
    """What is wrong or open, or that nothing is."""
    not_asked: tuple[str, ...]
    """Kinds of clauses that one look cannot decide."""


def perceive_outcome(
    recorded: Episode, localised: Episode | None, *, plan_id: str, task: Task | None = None
) -> PerceivedOutcome | None:
    """Ask the success predicate of a task about the poses localised after an execution.

    The predicate is the one the twin's replays are judged by. None without a localisation, or
    when the task file is not known.
    """
    info = recorded.info
    task = recorded_task(recorded) if task is None else task
    if localised is None or task is None:
        return None
    findings = evaluate_success(task, _rollout(recorded, localised, plan_id, task))
    asked = [f for f in findings if f.kind in DECIDED_BY_A_LOOK or f.value is not None]
    return PerceivedOutcome(
        episode=info.id,
        task=info.task,
        condition=info.condition,
        plan_id=plan_id,
        says=all_hold(asked),
        detail=_told(asked),
        not_asked=tuple(sorted({f.kind for f in findings} - {f.kind for f in asked})),
    )


def _told(findings: list[PredicateResult]) -> str:
    wrong = [f.detail for f in findings if f.value is not True]
    return "; ".join(wrong) or "; ".join(f.detail for f in findings if f.kind in ("inside", "on"))


def _rollout(recorded: Episode, localised: Episode, plan_id: str, task: Task) -> Rollout:
    """Two instants: as localised before, and after; a container that was not seen again stays."""
    before: dict[str, Float[np.ndarray, "4 4"]] = {}
    after: dict[str, Float[np.ndarray, "4 4"]] = {}
    extents: dict[str, Float[np.ndarray, "2 3"]] = {}
    seen_ns = 0
    for record in streams.localisations(localised):
        name, pose = str(record["object"]), record.get("T_base_object")
        if not record["found"] or pose is None:
            continue
        T = se3.pose_from_record(pose)
        if (record.get("phase"), record.get("plan_id")) != (AFTER, plan_id):
            before[name] = T if not after else before.get(name, T)
            continue
        after[name] = T
        seen_ns = max(seen_ns, int(record["stamp_ns"]))
        soft = record.get("soft_shape")
        if soft is not None and name in task.objects:
            rest = np.array(task.objects[name].size_m)
            extents[name] = np.stack([rest, np.array(soft["extents_m"])])
    stays = {name for name, model in task.objects.items() if model.fixed} | set(task.containers)
    still = {name: T for name, T in before.items() if name in stays}
    unknown = np.full((4, 4), np.nan)
    places = still | after
    return Rollout(
        stamps_ns=np.array([seen_ns - 1, seen_ns]),
        Ts_base_object={
            name: np.stack([before.get(name, unknown), T]) for name, T in places.items()
        },
        finger_contact=_away(recorded, seen_ns, places),
        extents_m=extents,
    )


def _away(
    recorded: Episode, seen_ns: int, places: Mapping[str, Float[np.ndarray, "4 4"]]
) -> dict[str, np.ndarray]:
    """Objects that the fingers are too far from to touch; of the others nothing is known."""
    p_tool_m = _tool_m(recorded, seen_ns)
    if p_tool_m is None:
        return {}
    return {
        name: np.zeros(2, dtype=bool)
        for name, T in places.items()
        if float(np.linalg.norm(T[:3, 3] - p_tool_m)) > AWAY_M
    }


def _tool_m(recorded: Episode, seen_ns: int) -> Float[np.ndarray, "3"] | None:
    """Where the tool was when the objects were seen: at the end of the recording, most often."""
    topics = [t for t in recorded.topics_of_type(schema.POSE_STAMPED) if t.endswith(TCP_POSE)][:1]
    for start_ns in (recorded.end_ns - TAIL_NS, None):
        found = recorded.messages(topics, start_ns=start_ns)
        try:
            track = streams.pose_track_of([message.data for message in found])
        except MalformedMessageError:
            return None
        if track is not None and (start_ns is None or track.stamps_ns[0] <= seen_ns):
            return np.asarray(track.at(np.array([seen_ns])).p_m[0])
    return None


NAMES = {True: "success", False: "failure"}
OPEN = "the localised poses leave it open"
Pair = tuple[TrialRow, PerceivedOutcome]


def label_results(perceived: Sequence[PerceivedOutcome], rows: Sequence[TrialRow]) -> Part:
    """Count the trials in which label and predicate say the same, and list the others."""
    if not perceived:
        reason = "no trial of a known task was localised after its execution"
        return Part(missing=(f"label against localised predicate: no data ({reason})",))
    of_episode: Mapping[str, PerceivedOutcome] = {outcome.episode: outcome for outcome in perceived}
    pairs = [(row, of_episode[row.episode]) for row in rows if row.episode in of_episode]
    tasks = sorted({row.task for row, _ in pairs})
    measurements = [_rate("", pairs)]
    measurements += [
        _rate(task, [pair for pair in pairs if pair[0].task == task]) for task in tasks
    ]
    return Part(
        measurements=tuple(measurements),
        tables=_disagreements(pairs),
        exclusions=tuple(_left_out(pairs)),
    )


def _known(pairs: Sequence[Pair]) -> list[Pair]:
    return [(r, w) for r, w in pairs if r.recorded is not None and w.says is not None]


def _rate(task: str, pairs: Sequence[Pair]) -> Measurement:
    """Measure the trials of one task, or of all when it is empty."""
    known = _known(pairs)
    agreed = sum(row.recorded is outcome.says for row, outcome in known)
    skipped = sorted({kind for _, outcome in known for kind in outcome.not_asked})
    without = f"; clauses that one look leaves open are not asked: {', '.join(skipped)}"
    quantity = LABEL_AGREED_OF_TASK if task else LABEL_AGREED
    where = f" of {task}" if task else ""
    return proportion(
        quantity.of(task=task, where=where, without=without if skipped else ""),
        agreed,
        len(known),
        counted="trial",
        reason_if_undefined="no trial has both a label and a decided predicate",
        episodes=[row.episode for row, _ in known],
    )


def _disagreements(pairs: Sequence[Pair]) -> tuple[Table, ...]:
    rows: list[tuple[Cell, ...]] = [
        (
            row.episode,
            row.task,
            row.condition.replace("_", " "),
            NAMES[bool(row.recorded)],
            NAMES[bool(outcome.says)],
            outcome.detail,
        )
        for row, outcome in _known(pairs)
        if row.recorded is not outcome.says
    ]
    if not rows:
        return ()
    return (
        Table(
            id="label_disagreements",
            title="Trials in which label and predicate disagree",
            columns=("episode", "task", "condition", "label", "predicate", "what it found"),
            rows=tuple(rows),
            note="Look at these: a wrong label, a wrong localisation, or a predicate that does not "
            "mean what people mean.",
        ),
    )


def _left_out(pairs: Sequence[Pair]) -> list[Exclusion]:
    return [
        Exclusion(
            episode=row.episode, scope="label against predicate", reason=f"{OPEN}: {outcome.detail}"
        )
        for row, outcome in pairs
        if outcome.says is None
    ]
