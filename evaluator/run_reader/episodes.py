"""Read what an episode says: a recorded one of plan, verdict, outcome, a derived one of a replay.

Only its metadata and its few messages about plans, events, verdicts and places are read; how the
arm moved is left to ``motion``.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from bridge.clock import NS_PER_S
from bridge.episode import metadata, schema
from bridge.episode.catalogue import outcome_of
from bridge.episode.executions import NO_PLAN, with_execution
from bridge.episode.reader import Episode, RawMessage
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import verdicts
from bridge.errors import GstError
from bridge.task.plan import SCHEMA_VERSION, Plan
from bridge.task.record import parse_record
from bridge.task.verdict import STAND_IN_ENGINE, Verdict
from evaluator.errors import EvaluatorError

FITTED_TO = "fitted_to"
"""Setting of a replay: ids of the recorded runs from which something was identified."""
MADE_BY = ("replay_version", "calibration_id")
COMPARED = (*MADE_BY, "config", FITTED_TO, metadata.SECOND_ENGINE_KEY, metadata.ROLLOUT)
"""Settings of a replay that somebody reads here; tasks and poses are most of the bytes."""


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """One episode of a run, recorded or derived, as it lies on the disk."""

    folder: Path
    """That ``name`` is relative to: the run's."""
    name: str
    """Of its first part, with forward slashes."""
    sha256: str
    """Of the bytes of all parts, one after the other."""

    @property
    def path(self) -> Path:
        """Its first part; made when asked for, most files of a large run are not opened again."""
        return self.folder / self.name

    @property
    def file_name(self) -> str:
        """The name of the file without folder."""
        return self.name.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """The name of the file without folder and ending."""
        return self.file_name.rpartition(".")[0]


@dataclass(frozen=True, kw_only=True)
class VerdictSummary:
    """One verdict on one plan."""

    accepted: bool | None
    """None where the twin could not decide."""
    why_undecided: str
    p_success: float | None
    """As it was stated: with a posterior each varied replay counts as far as it is trusted."""
    first_failing: str | None
    """ik, clearance, terminal or a further check; None where none is false."""
    failing_cause: str | None
    """The cause alone, to be counted: ``collision``, ``unreachable`` ..."""
    failing_detail: str | None
    """Cause, bodies and time, to be read."""
    engine: str = ""
    failing_bodies: tuple[str, ...] = ()
    """What touched, came too close or was lost, in the verdict's order."""
    failing_t_ns: int | None = None
    """First instant at which it is false, since the start of the plan."""
    done: bool | None = None
    """Whether the task was done in the end, whatever else was wrong."""


def summarise_verdict(verdict: Verdict) -> VerdictSummary:
    """Sum a verdict up."""
    name = verdict.first_failing
    factor = None if name is None else verdict.factors()[name]
    undecided = [each for each, known in verdict.factors().items() if known.value is None]
    probability = None if verdict.p_success is None else verdict.p_success.get("value")
    return VerdictSummary(
        accepted=verdict.accepted,
        why_undecided=verdict.reason or f"{' and '.join(undecided)} undecided",
        p_success=None if probability is None else float(probability),
        first_failing=name,
        failing_cause=None if factor is None else factor.cause,
        failing_detail=_detail(verdict),
        engine=verdict.engine,
        failing_bodies=() if factor is None else factor.bodies,
        failing_t_ns=None if factor is None else factor.first_t_ns,
        done=verdict.terminal.value,
    )


def _detail(verdict: Verdict) -> str | None:
    if verdict.first_failing is None:
        return None
    factor = verdict.factors()[verdict.first_failing]
    parts = [factor.cause, " and ".join(factor.bodies), factor.detail]
    if factor.first_t_ns is not None:
        parts.append(f"at {factor.first_t_ns / NS_PER_S:.2f} s")
    return ", ".join(part for part in parts if part) or None


Position = tuple[float, float, float]
"""In the robot's base frame [m]."""


@dataclass(frozen=True, kw_only=True)
class LocalisedPosition:
    """Where an object was localised."""

    object_id: str
    stamp_ns: int
    p_m: Position


@dataclass(frozen=True, kw_only=True)
class StageTime:
    """When a plan means to do one of its stages, since its start."""

    id: str
    t_start_ns: int
    t_end_ns: int


@dataclass(frozen=True, kw_only=True)
class RecordedFacts:
    """What one recorded episode says of itself, with the label given to it afterwards."""

    info: metadata.EpisodeInfo
    began_ns: int = 0
    """When its recording began; 0 without messages."""
    outcome: metadata.Outcome | None = None
    """As the operator labelled it; a label given after the fact wins."""
    num_plans: int = 0
    num_plans_sent: int = 0
    plan_id: str | None = None
    """The plan actually sent: the last one whose execution started; ``NO_PLAN`` where the robot was
    moved without any."""
    plan_stages: tuple[StageTime, ...] = ()
    """Of that plan."""
    started_ns: int | None = None
    """When its execution started and ended, on the cell's clock."""
    ended_ns: int | None = None
    verdict: VerdictSummary | None = None
    """The last verdict on that plan made before its execution started."""
    start_positions_m: dict[str, Position] = field(default_factory=dict)
    """Where objects were last localised before the start."""
    broken: str = ""
    """Why the trial cannot be judged, empty where it can."""


@dataclass(kw_only=True)
class _Log:
    """What happened with plans, in the order it was received."""

    plans: dict[str, tuple[StageTime, ...]] = field(default_factory=dict)
    sent: list[str] = field(default_factory=list)
    started_ns: int | None = None
    ended_ns: int | None = None
    first_start_ns: dict[str, int] = field(default_factory=dict)
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    label: metadata.Outcome | None = None
    localised: list[bytes] = field(default_factory=list)


def read_recorded(run: RunFolder, path: Path) -> RecordedFacts:
    """Sum up a recorded episode; of one that is no trial, only who and what."""
    episode = Episode.open(path)
    info, outcome = episode.info, episode.outcome
    if info.kind == metadata.RETRY:
        return RecordedFacts(info=info, outcome=outcome_of(run, episode))
    if info.kind != "trial":
        return RecordedFacts(info=info, outcome=outcome)
    try:
        return _read_trial(run, episode, info)
    except GstError as error:
        broken = str(error)
    except (OSError, TypeError, ValueError) as error:  # another program wrote it, or the disk
        broken = f"its label or messages cannot be read ({error})"
    return RecordedFacts(info=info, outcome=outcome, broken=broken)


def _read_trial(run: RunFolder, episode: Episode, info: metadata.EpisodeInfo) -> RecordedFacts:
    log = _read_log(episode)
    if not log.sent:
        for event in with_execution(episode, ()):
            _note_event(log, event)
    plan_id = log.sent[-1] if log.sent else None
    verdict = None if plan_id is None else log.verdicts.get(plan_id)
    return RecordedFacts(
        info=info,
        began_ns=episode.start_ns,
        outcome=outcome_of(run, episode) or log.label,
        num_plans=len(log.plans),
        num_plans_sent=len(set(log.sent) - {NO_PLAN}),
        plan_id=plan_id,
        plan_stages=() if plan_id is None else log.plans.get(plan_id, ()),
        started_ns=log.started_ns,
        ended_ns=log.ended_ns,
        verdict=None if verdict is None else summarise_verdict(verdict),
        start_positions_m=positions_at_start(localised_positions(log.localised), log.started_ns),
    )


def localised_positions(localisations: Iterable[bytes]) -> list[LocalisedPosition]:
    """Return where objects were found, in log order."""
    places = []
    for data in localisations:
        record = parse_record(data, name="localisation")
        pose = record.get("T_base_object")
        if record["found"] and pose is not None:
            x, y, z = pose["p_m"]
            about = {"object_id": record["object"], "stamp_ns": record["stamp_ns"]}
            places.append(LocalisedPosition(**about, p_m=(x, y, z)))
    return places


def positions_at_start(
    places: Iterable[LocalisedPosition], started_ns: int | None
) -> dict[str, Position]:
    """Return the last place of each object that is not younger than the start, where it is known.

    A later one of an object replaces an earlier one.
    """
    before = (each for each in places if started_ns is None or each.stamp_ns <= started_ns)
    return {each.object_id: each.p_m for each in before}


def _read_log(episode: Episode) -> _Log:
    log = _Log()
    topics = [
        topic
        for name in (schema.PLAN, schema.EVENT, schema.VERDICT, schema.LOCALISATION)
        for topic in episode.topics_of_type(name)
    ]
    for message in episode.messages(topics):
        if message.type_name == schema.PLAN:
            name, stages = _plan_of(message.data)
            log.plans[name] = stages
        elif message.type_name == schema.VERDICT:
            _note_verdict(log, message)
        elif message.type_name == schema.LOCALISATION:
            log.localised.append(message.data)
        else:
            _note_event(log, parse_record(message.data, name="event", package="bridge.episode"))
    return log


class _Outline(msgspec.Struct):
    """A plan without its hundreds of waypoints, which take longer to check than all the rest."""

    schema_version: int
    id: str
    stages: tuple[StageTime, ...] = ()


def _plan_of(data: bytes) -> tuple[str, tuple[StageTime, ...]]:
    """Read a plan's id and stages."""
    try:
        outline = msgspec.json.decode(data, type=_Outline)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        outline = None
    if outline is not None and outline.schema_version == SCHEMA_VERSION and outline.id:
        return outline.id, outline.stages
    return Plan.from_json(data).id, ()  # which says what is wrong


def _note_verdict(log: _Log, message: RawMessage) -> None:
    decided = Verdict.from_json(message.data)
    # It may arrive late over its own connection; its stamp is the cell's time.
    started_ns = log.first_start_ns.get(decided.plan_id)
    in_time = started_ns is None or message.publish_time_ns < started_ns
    if in_time and decided.trajectory == "planned":
        log.verdicts[decided.plan_id] = decided


def _note_event(log: _Log, event: Mapping[str, Any]) -> None:
    plan_id = event.get("plan_id") or NO_PLAN
    if event["type"] == "execution_started":
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
            log.label = metadata.build(metadata.Outcome, {**known, "stages": stages})


def first_divergence(episode: Episode) -> str:
    """Read what parts planned, executed and recorded first; empty where nothing does."""
    messages = list(episode.messages(episode.topics_of_type(schema.DIVERGENCE)))
    first = parse_record(messages[-1].data, name="divergence")["first"] if messages else None
    return "" if first is None else str(first["attribution"])


@dataclass(frozen=True, kw_only=True)
class DerivedFacts:
    """What one derived episode says of itself."""

    info: metadata.EpisodeInfo
    derived: metadata.Derived
    verdict: VerdictSummary | None = None
    """Of a dynamic replay: the last verdict on the plan it replays."""
    divergence: str = ""
    """Of a dynamic replay of what was executed: what parts it first."""
    places: tuple[LocalisedPosition, ...] = ()
    """Of a localisation: where objects were found."""
    broken: str = ""
    """Why verdict or places cannot be read, empty where they can."""


@dataclass(frozen=True, kw_only=True)
class DerivedFile(RunFile):
    """One derived episode and what it was made from."""

    facts: DerivedFacts

    @property
    def info(self) -> metadata.EpisodeInfo:
        """Who, what and when."""
        return self.facts.info

    @property
    def derived(self) -> metadata.Derived:
        """What it was made from."""
        return self.facts.derived

    @property
    def why_not_counted(self) -> str:
        """Why it never enters a number, whatever it says; empty where it may."""
        return metadata.why_not_counted(self.derived, stand_in=self.info.stand_in)

    @property
    def episode(self) -> Episode:
        """Open it; nothing is held open, so whoever asks twice opens it twice."""
        return Episode.open(self.path)

    @property
    def age(self) -> tuple[int, str]:
        """What the newest file has the largest of."""
        return self.path.stat().st_mtime_ns, self.path.name


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A dynamic replay of one plan with its verdict, or the reason there is none."""

    file: DerivedFile | None = None
    verdict: VerdictSummary | None = None
    reason: str | None = None

    @property
    def accepted(self) -> bool | None:
        """What the twin said; None without a decided verdict."""
        return None if self.verdict is None else self.verdict.accepted


def read_derived(path: Path) -> DerivedFacts:
    """Sum up a derived episode from its metadata and its few messages about verdicts or places."""
    episode = Episode.open(path)
    derived = episode.derived
    if derived is None:
        raise EvaluatorError("no 'derived' metadata: it does not say what it was made from")
    info, derived = episode.info, _as_compared(derived)
    try:
        if _is_dynamic(derived):
            mine = [each for _, each in verdicts(episode) if each.plan_id == derived.plan_id]
            last = summarise_verdict(mine[-1]) if mine else None
            first = first_divergence(episode) if derived.trajectory == "executed" else ""
            return DerivedFacts(info=info, derived=derived, verdict=last, divergence=first)
        if derived.kind == "localised":
            topics = episode.topics_of_type(schema.LOCALISATION)
            places = localised_positions(message.data for message in episode.messages(topics))
            return DerivedFacts(info=info, derived=derived, places=tuple(places))
    except GstError as error:
        return DerivedFacts(info=info, derived=derived, broken=str(error))
    return DerivedFacts(info=info, derived=derived)


def _as_compared(derived: metadata.Derived) -> metadata.Derived:
    """Keep the settings of a replay that are compared; the seed stands beside them."""
    if derived.kind == "views":
        return derived
    kept = {name: derived.settings[name] for name in COMPARED if name in derived.settings}
    if isinstance(config := kept.get("config"), dict):
        kept["config"] = {name: value for name, value in config.items() if name != "seed"}
    return replace(derived, settings=kept)


def rollout_of(file: DerivedFile) -> Mapping[str, Any]:
    """What a rollout says of itself: policy, task, start, number, success and who acted."""
    row = file.derived.settings.get(metadata.ROLLOUT)
    return row if isinstance(row, dict) else {}


def _is_dynamic(derived: metadata.Derived) -> bool:
    return derived.kind == "replay" and derived.mode == "dynamic"


class DerivedIndex:
    """Derived episodes by what they were made from, so that none is looked for twice."""

    def __init__(self, files: Iterable[DerivedFile]) -> None:
        """Sort the derived episodes of a run."""
        self._replays: dict[tuple[str, str | None, str | None], list[DerivedFile]] = {}
        self._localised: dict[str, list[DerivedFile]] = {}
        self._rollouts: dict[tuple[str, ...], dict[int, DerivedFile]] = {}
        for file in files:
            made = file.derived
            if (row := rollout_of(file)).get("success") is not None:
                whose = tuple(str(row.get(name, "")) for name in ("policy", "task", "start_id"))
                numbered, number = self._rollouts.setdefault(whose, {}), int(row.get("number") or 0)
                numbered[number] = _newest([file, numbered.get(number, file)])
            if _is_dynamic(made):
                key = (made.source_episode, made.plan_id, made.trajectory)
                self._replays.setdefault(key, []).append(file)
            elif made.kind == "localised":
                self._localised.setdefault(made.source_episode, []).append(file)

    def replay(self, *, source: str, source_sha256: str, plan_id: str, trajectory: str) -> Replay:
        """Find the dynamic replay of a recorded episode's plan, planned or executed.

        The newest file wins where several settings were tried; what never counts is passed over.
        """
        made = self._replays.get((source, plan_id, trajectory), [])
        if not made:
            reason = f"no dynamic replay of the {trajectory} trajectory of plan {plan_id}"
            return Replay(reason=reason)
        current = _current(made, source_sha256)
        if not current:
            stale = f"{made[0].path.name} was made from another version of the episode (its hash "
            return Replay(reason=f"{stale}differs); replay it again")
        counted = [file for file in current if not file.why_not_counted]
        file = _newest(counted or current)
        if not counted:
            return Replay(reason=f"{file.path.name} does not count: {file.why_not_counted}")
        decided = file.facts.verdict
        if file.facts.broken:
            return Replay(file=file, reason=f"{file.path.name}: {file.facts.broken}")
        if decided is None:
            return Replay(file=file, reason=f"{file.path.name} holds no verdict")
        undecided = f"the twin could not decide the {trajectory} replay: {decided.why_undecided}"
        why = undecided if decided.accepted is None else None
        return Replay(file=file, verdict=decided, reason=why)

    def rollout(self, info: metadata.EpisodeInfo) -> DerivedFile | None:
        """Take the next rollout of a trial's policy from its start; each is taken once."""
        left = self._rollouts.get((info.policy, info.task, info.start_id or info.id), {})
        return left.pop(min(left)) if left else None

    def answer_of_cells_engine(
        self, *, source: str, source_sha256: str, plan_id: str
    ) -> bool | None:
        """What the planned replay in the engine that moved the stand-in cell says of a plan.

        It never counts as the twin's answer; it is what another simulation has to be held against.
        None without such a replay, or where it could not decide.
        """
        made = _current(self._replays.get((source, plan_id, "planned"), []), source_sha256)
        stand_in = [file for file in made if file.info.stand_in]
        alone = [f for f in stand_in if (f.derived.engine or "").startswith(STAND_IN_ENGINE)]
        decided = _newest(alone).facts.verdict if alone else None
        return None if decided is None or " and " in (decided.engine or "") else decided.accepted

    def localised(self, *, source: str, source_sha256: str) -> DerivedFile | None:
        """Find the newest localisation of a recorded episode."""
        current = _current(self._localised.get(source, []), source_sha256)
        return _newest(current) if current else None


def _current(files: Iterable[DerivedFile], source_sha256: str) -> list[DerivedFile]:
    """Leave out what was made from other bytes than the recorded episode holds now."""
    return [file for file in files if file.derived.source_sha256 in ("", source_sha256)]


def _newest(files: list[DerivedFile]) -> DerivedFile:
    return files[0] if len(files) == 1 else max(files, key=lambda file: file.age)
