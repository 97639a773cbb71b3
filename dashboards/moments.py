"""The moment at which recording and twin of a trial first differ, and why."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from bridge.clock import NS_PER_S
from bridge.episode import schema, streams
from bridge.episode.executions import executed_events
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict
from evaluator.compare.attribution import SAID, attributed
from evaluator.review_index import stamp_of
from evaluator.trial_row import TrialRow
from twin.replay.deciding import goes_with_success, what_decides

MOST_WORDS = 20
"""Of a cause."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """When recording and twin first differ, as the replays of the plan sent tell it."""

    plan_id: str
    t_ns: int
    """Since the start of the plan."""
    text: str
    """What differs then."""

    @property
    def t_s(self) -> float:
        """Seconds into the plan."""
        return self.t_ns / NS_PER_S


def moment_of(run: RunFolder, row: TrialRow) -> Moment | None:
    """Find the first divergence that the replays of a trial tell, or the first failing factor."""
    names = filter(None, (row.executed_replay, row.planned_replay))
    paths = (run.derived_dir / name for name in names)
    return next(filter(None, (_moment(path, stamp_of(path)) for path in paths)), None)


@lru_cache(maxsize=4096)
def _moment(path: Path, _stamp: str) -> Moment | None:
    with suppress(GstError):  # the trial's own page says what is wrong with the file
        episode = Episode.open(path)
        messages = episode.messages(episode.topics_of_type(schema.DIVERGENCE))
        for message in messages:
            record = parse_record(message.data, name="divergence")
            if first := record["first"]:
                return Moment(
                    plan_id=record["plan_id"], t_ns=first["first_t_ns"], text=first["detail"]
                )
        for _, verdict in streams.verdicts(episode):
            name = verdict.first_failing
            factor = verdict.factors()[name] if name else None
            if factor is not None and factor.first_t_ns is not None:
                text = factor.detail or factor.cause or f"{name} fails in the twin"
                return Moment(plan_id=verdict.plan_id, t_ns=factor.first_t_ns, text=text)
    return None


@dataclass(frozen=True, kw_only=True)
class Cause:
    """Why recorded and twin disagree, as the replay that is compared tells it."""

    text: str
    """What differs first, in few words."""
    margin: str
    """How far what decides is from the other answer; empty where the verdict does not say."""
    varied: Mapping[str, float] | None
    """How many varied replays succeed; None where nothing was varied."""
    goes_with: Mapping[str, float]
    """What goes with their success, in words, and how strongly, 0 to 1; or why nothing does: 0."""


def cause_of(run: RunFolder, row: TrialRow) -> Cause | None:
    """Put together what the replays tell of a disagreement; None where the two sides agree."""
    if row.agrees is not False:
        return None
    moment, verdict = moment_of(run, row), _verdict_of(run, row)
    text = moment.text if moment else row.failing_detail or "no replay tells what differs first"
    words = (SAID.get(attributed(row) or "", "") + text).split()
    margin = "" if verdict is None else (verdict.terminal.detail or "").partition(";")[0]
    return Cause(
        text=" ".join(words[:MOST_WORDS]) + (" …" if len(words) > MOST_WORDS else ""),
        margin="; ".join(what_decides(verdict)) or margin if verdict else "",
        varied=verdict.p_success if verdict else None,
        goes_with=goes_with_success(verdict) if verdict else {},
    )


def _verdict_of(run: RunFolder, row: TrialRow) -> Verdict | None:
    path = run.derived_dir / (row.twin_replay or "")
    return _verdict(path, stamp_of(path)) if row.twin_replay else None


@lru_cache(maxsize=64)
def _verdict(path: Path, _stamp: str) -> Verdict | None:
    try:
        return streams.verdicts(Episode.open(path))[-1][1]
    except (GstError, IndexError):  # the trial's own page says what is wrong with the file
        return None


def recorded_ns(path: Path, moment: Moment) -> int | None:
    """Return when a moment is on the recording's clock; None where its plan was not executed."""
    start_ns, _ = streams.execution_ns(executed_events(Episode.open(path)), moment.plan_id)
    return None if start_ns is None else start_ns + moment.t_ns
