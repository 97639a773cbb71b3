"""Episodes as tidy CSV files, one per family of topics, and one line per episode.

RFC 4180: comma, CRLF, quotes doubled. Times are whole nanoseconds and, beside them, seconds with
nine decimals. Numbers are the shortest decimals that read back as the same 64-bit number. An empty
field is unknown.
"""

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from bridge.clock import NS_PER_S, ClockChoice
from bridge.episode import schema
from bridge.episode.catalogue import outcome_of
from bridge.episode.cdr.messages import JointSample, PoseSample
from bridge.episode.clocks import open_episode
from bridge.episode.reader import Episode, RawMessage
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import GRIPPER_STATE, is_truth
from bridge.exchange.output import message_named, new_folder, write_note
from bridge.geometry import se3
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict
from bridge.terminal import Advance

Value = str | int | float | bool | None
Rows = Iterator[tuple[int, list[Value]]]
"""Source time [ns] and the fields after the common ones."""

COMMON = {
    "file": "the episode file, relative to the run",
    "topic": "where it was published",
    "stamp_ns": "when it happened, the source's clock [ns]",
    "stamp_s": "the same in seconds, nine decimals",
    "log_ns": "when it was received [ns]",
}
_JOINT = {
    "joint": "name of the joint",
    "position": "[rad], or [m] for a sliding joint or a width",
    "velocity": "position per second; empty where it was not published",
    "effort": "[Nm], or [N]; empty where it was not published",
}
_POSE = {
    "frame": "the frame the pose is given in",
    **{f"{axis}_m": f"position along {axis} [m]" for axis in "xyz"},
    **{f"q{axis}": f"quaternion of the orientation, {axis}" for axis in "wxyz"},
}
_EVENT = {
    "type": "execution_started, execution_ended, stage_started, gripper, replan, label, mark ...",
    "plan_id": "the plan it belongs to",
    "stage_id": "the stage it belongs to",
    "text": "words of a mark or a label",
    "result": "success, failure or unknown, of a label",
    "k": "successes of a label",
    "n": "out of so many",
    "data": "whatever else was published, as JSON",
}
_FACTORS = ("ik", "clearance", "terminal")
_VERDICT = {
    "plan_id": "the plan judged",
    "trajectory": "planned or executed",
    "mode": "kinematic or dynamic",
    "accepted": "the product of the three factors; empty is undecided",
    **{
        name: meaning
        for factor in _FACTORS
        for name, meaning in (
            (factor, "true, false, or empty where undecided"),
            (f"{factor}_first_t_ns", "first failure, from the start of the trajectory [ns]"),
            (f"{factor}_cause", "why"),
        )
    },
    "p_success": "estimated probability of success",
    "p_low": "lower end of its interval",
    "p_high": "upper end of its interval",
    "engine": "physics engine",
    "seed": "its seed",
    "scene_hash": "the scene it was judged in",
    "reason": "why nothing could be decided",
}
_DROPS = {
    "of_topic": "the topic that is counted",
    "second": "which second of the recording",
    "received": "messages",
    "gaps": "messages missing by the source's count",
    "queue_drops": "messages that did not fit the recorder's queues",
    "shed": "messages left out on purpose under overload",
    "undecodable": "messages kept but not readable",
    "bytes": "received bytes",
}


@dataclass(frozen=True)
class TableKind:
    """One CSV file: its columns and how a message becomes its rows."""

    name: str
    type_name: str
    columns: dict[str, str]
    """Column names and what they mean, after the common ones."""
    rows: Callable[[RawMessage], Rows]
    ending: str = ""
    """Only topics that end so."""
    not_ending: tuple[str, ...] = field(default=())

    def takes(self, topic: str, type_name: str) -> bool:
        """Say whether a topic's messages belong into this file."""
        return (
            type_name == self.type_name
            and topic.endswith(self.ending)
            and not topic.endswith(self.not_ending or ("\0",))
            and not is_truth(topic)
        )


def _joints(message: RawMessage) -> Rows:
    sample = JointSample.from_cdr(message.data)
    for number, name in enumerate(sample.names):
        values: list[Value] = [name]
        for column in (sample.position, sample.velocity, sample.effort):
            values.append(float(column[number]) if number < len(column) else None)
        yield sample.stamp_ns, values


def _poses(message: RawMessage) -> Rows:
    sample = PoseSample.from_cdr(message.data)
    q, p = se3.split(sample.T_frame_body)
    yield sample.stamp_ns, [sample.frame_id, *map(float, p), *map(float, q)]


def _events(message: RawMessage) -> Rows:
    record = parse_record(message.data, name="event", package="bridge.episode")
    outcome = record.get("outcome") or {}
    data = record.get("data")
    values = [record["type"], *(record.get(name) for name in ("plan_id", "stage_id", "text"))]
    values += [outcome.get(name) for name in ("result", "k", "n")]
    told = None if data is None else json.dumps(data, sort_keys=True, separators=(",", ":"))
    yield int(record["stamp_ns"]), [*values, told]


def _verdicts(message: RawMessage) -> Rows:
    verdict = Verdict.from_json(message.data)
    values: list[Value] = [verdict.plan_id, verdict.trajectory, verdict.mode, verdict.accepted]
    for name in _FACTORS:
        factor = getattr(verdict, name)
        values += [factor.value, factor.first_t_ns, factor.cause]
    p = verdict.p_success or {}
    values += [p.get("value"), p.get("low"), p.get("high")]
    values += [verdict.engine, verdict.seed, verdict.scene_hash, verdict.reason]
    yield message.publish_time_ns, values


def _drops(message: RawMessage) -> Rows:
    record = parse_record(message.data, name="drops", package="bridge.episode")
    counts = [record.get(name) for name in tuple(_DROPS)[2:]]
    yield message.publish_time_ns, [record["topic"], record["second"], *counts]


TABLES = (
    TableKind("joints", schema.JOINT_STATE, _JOINT, _joints, not_ending=(GRIPPER_STATE,)),
    TableKind("gripper", schema.JOINT_STATE, _JOINT, _joints, ending=GRIPPER_STATE),
    TableKind("poses", schema.POSE_STAMPED, _POSE, _poses),
    TableKind("events", schema.EVENT, _EVENT, _events),
    TableKind("verdicts", schema.VERDICT, _VERDICT, _verdicts),
    TableKind("drops", schema.DROPS, _DROPS, _drops),
)


def seconds_text(stamp_ns: int) -> str:
    """Seconds with nine decimals, exact."""
    sign, stamp_ns = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    seconds, rest = divmod(stamp_ns, NS_PER_S)
    return f"{sign}{seconds}.{rest:09d}"


def field_text(value: Value) -> str:
    """One field: empty for unknown, true or false, shortest exact decimals for numbers."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else "" if value is None else str(value)


EPISODE_COLUMNS = {
    "file": "the episode file, relative to the run",
    "id": "its id",
    "kind": "scan, trial, retry, probe or imported",
    "task": "what was to be achieved",
    "instruction": "in words",
    "condition": "without_replanning or with_replanning",
    "policy": "who planned",
    "trial": "number of the trial",
    "start_id": "trials with the same start share it",
    "operator": "who watched",
    "robot": "which robot",
    "cell": "which cell",
    "stand_in": "true for a simulated laboratory",
    "result": "success, failure or unknown; a label given afterwards counts",
    "k": "successes",
    "n": "out of so many",
    "start_ns": "first log time [ns]",
    "end_ns": "last log time [ns]",
    "messages": "how many there are",
}
_INFO = tuple(EPISODE_COLUMNS)[1:13]


class _Sheet:
    """One CSV file being written; it is made when its first row comes."""

    def __init__(self, path: Path, columns: Sequence[str], stack: ExitStack) -> None:
        self.rows = 0
        self._path = path
        self._columns = columns
        self._stack = stack
        self._stream: TextIO | None = None

    def write(self, cells: Sequence[str]) -> None:
        if self._stream is None:
            self._stream = self._stack.enter_context(
                self._path.open("w", newline="", encoding="utf-8")
            )
            self._writer = csv.writer(self._stream, lineterminator="\r\n")
            self._writer.writerow(self._columns)
        self._writer.writerow(cells)
        self.rows += 1


def episode_files(source: Path, *, derived: bool) -> tuple[list[Path], Path]:
    """Return the episode files of a run, or the one given, and the folder they are named from."""
    if not source.is_dir():
        return [source], source.parent
    run = RunFolder.open(source)
    run.refuse_empty()
    return run.episodes() + (run.derived() if derived else []), source


def export_csv(
    source: Path,
    out: Path,
    *,
    derived: bool,
    clock: ClockChoice = "recorded",
    force: bool,
    advance: Advance,
) -> dict[str, int]:
    """Write ``episodes.csv`` and one CSV file per family of topics that has messages.

    Raises:
        UsageError: When there is nothing to export, or ``out`` may not be replaced.
    """
    files, base = episode_files(source, derived=derived)
    run = RunFolder(base) if source.is_dir() else None
    with new_folder(out, force=force) as folder:
        with ExitStack() as stack:
            sheets = {
                kind.name: _Sheet(folder / f"{kind.name}.csv", [*COMMON, *kind.columns], stack)
                for kind in TABLES
            }
            sheets["episodes"] = _Sheet(folder / "episodes.csv", list(EPISODE_COLUMNS), stack)
            for done, path in enumerate(files, start=1):
                name = path.relative_to(base).as_posix()
                episode = open_episode(path, clock=clock)
                sheets["episodes"].write(_episode_cells(name, episode, run))
                _write_messages(name, episode, sheets)
                advance(done, name)
        rows = {f"{name}.csv": sheet.rows for name, sheet in sheets.items() if sheet.rows}
        written = [kind for kind in TABLES if sheets[kind.name].rows]
        columns = {f"{kind.name}.csv": {**COMMON, **kind.columns} for kind in written}
        columns["episodes.csv"] = dict(EPISODE_COLUMNS)
        choices = {"columns": columns, "stand_in_truth": "left out", "clock": clock}
        write_note(folder, made_by="export csv", sources=files, choices=choices)
    return rows


def _write_messages(name: str, episode: Episode, sheets: dict[str, _Sheet]) -> None:
    taken = {
        topic: kind
        for topic, summary in episode.topics().items()
        for kind in TABLES
        if any(kind.takes(topic, name) for name in summary.types or (summary.type_name,))
    }
    for kind, cells in _rows(name, episode, taken):
        sheets[kind.name].write(cells)


def _rows(
    name: str, episode: Episode, taken: dict[str, TableKind]
) -> Iterator[tuple[TableKind, list[str]]]:
    counts = dict.fromkeys(taken, 0)
    for message in episode.messages(taken):
        kind = taken[message.topic]
        counts[message.topic] += 1
        if message.type_name != kind.type_name:  # a topic may carry two types
            continue
        with message_named(episode, message.topic, counts[message.topic]):
            rows = list(kind.rows(message))
        for stamp_ns, values in rows:
            log_ns = str(message.log_time_ns)
            times = [str(stamp_ns), seconds_text(stamp_ns), log_ns]
            yield kind, [name, message.topic, *times, *map(field_text, values)]


def _episode_cells(name: str, episode: Episode, run: RunFolder | None) -> list[str]:
    info = episode.info
    outcome = episode.outcome if run is None else outcome_of(run, episode)
    counted = [None] * 3 if outcome is None else [outcome.result, outcome.k, outcome.n]
    messages = sum(summary.count for summary in episode.topics().values())
    span = (episode.start_ns, episode.end_ns)
    values = [*(getattr(info, field) for field in _INFO), *counted, *span, messages]
    return [name, *map(field_text, values)]
