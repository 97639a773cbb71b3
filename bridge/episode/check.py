"""Verify an episode: every CRC, index and stream, and say what is wrong with what it holds.

Broken is what contradicts itself: damage, indexes and counts that disagree with the data, messages
that are not what they promise. ``health`` names what is wrong with a whole
file (``exit_code`` 3). Files of other programs are held to the format only.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bridge.episode import schema
from bridge.episode.check_file import Faults, checked_messages
from bridge.episode.check_topics import Decoder, TopicCheck, TopicWatch
from bridge.episode.contract import (
    RECORD_NAME,
    Contract,
    ContractError,
    Presence,
    Span,
    contract_from,
    findings_of,
    judge,
    unseen_losses,
)
from bridge.episode.health import HealthFinding, drops_logged, in_order, in_words, unreadable
from bridge.episode.mcap.data_walk import ScannedMessage
from bridge.episode.metadata import BY_DISK
from bridge.episode.reader import Episode
from bridge.episode.topics import type_of_topic
from bridge.episode.writer import LIBRARY
from bridge.errors import BridgeError


@dataclass(kw_only=True)
class CheckReport:
    """What was found in one episode. ``exit_code``: 0 clean, 1 broken, 3 losses."""

    path: Path
    messages: int = 0
    topics: dict[str, TopicCheck] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    """What makes it broken; the first 20."""
    num_faults: int = 0
    notes: list[str] = field(default_factory=list)
    """What a person may want to know; never makes it broken."""
    declared_losses: int = 0
    undeclared_losses: int = 0
    """Numbers missing on topics of a recording whose drop log does not list them."""
    findings: list[HealthFinding] = field(default_factory=list)
    """What is wrong with what it holds, the worst first."""
    start_ns: int = 0
    presences: dict[str, Presence] = field(default_factory=dict)

    def find(self, name: str, about: str, text: str) -> None:
        """Take one more finding."""
        self.findings.append(HealthFinding(name=name, about=about, text=text))

    @property
    def exit_code(self) -> int:
        """Status of the ``check`` command."""
        return 1 if self.faults else 3 if self.findings else 0

    @property
    def summary(self) -> str:
        """A word or two."""
        if self.faults or not self.findings:
            return "broken" if self.faults else "clean"
        return in_words(self.findings[0].name)

    def lines(self) -> list[str]:
        """What to print: one line, and one for each fault and note."""
        lost = f"{self.declared_losses} dropped (logged)"
        if self.undeclared_losses:
            lost += f", {self.undeclared_losses} more missing"
        lines = [f"{self.path.name}: {self.summary}, {self.messages} messages, {lost}"]
        lines += [f"  {fault}" for fault in self.faults]
        told = (each for each in self.findings if f"{each.about}: {each.text}" not in self.faults)
        lines += [f"  {found.line(self.start_ns)}" for found in told]
        if self.num_faults > len(self.faults):
            lines.append(f"  and {self.num_faults - len(self.faults)} more faults")
        return lines + [f"  note: {note}" for note in self.notes]

    def to_json(self) -> dict[str, Any]:
        """Everything, for ``--json``."""
        found = asdict(self)
        del found["path"], found["presences"], found["start_ns"]
        return {"file": str(self.path), "state": self.summary, **found}


def check_episode(path: Path, *, contract: Contract | None = None) -> CheckReport:
    """Read every byte of an episode, and decode every type this project knows."""
    report = CheckReport(path=path)
    faults = Faults()
    watch = _Watch()
    episode = _open(path, faults, watch)
    if episode is not None:
        watch.read(checked_messages(path, faults))
        _find_ends(report, episode)
        _check_metadata(episode, faults)
    _judge_topics(report, episode, watch, faults)
    if episode is not None:
        report.start_ns, records = episode.start_ns, episode.metadata_records
        is_judged = "recorder" in records or ("recovered" in records and RECORD_NAME in records)
        if is_judged:
            _judge_presence(report, episode, watch, faults, contract)
    report.faults, report.num_faults = faults.listed, faults.count
    report.findings = in_order(report.findings)
    return report


def _open(path: Path, faults: Faults, watch: "_Watch") -> Episode | None:
    """Open an episode; one that cannot be opened is walked through for what else is wrong."""
    try:
        return Episode.open(path)
    except BridgeError as error:
        said = str(error)
    faults.add(said)
    found = Faults()
    watch.read(checked_messages(path, found))
    for text in found.listed:
        if text.rpartition("damaged: ")[2] not in said:
            faults.add(text)
    return None


class _Watch:
    """All topics."""

    def __init__(self) -> None:
        self.decoder = Decoder()
        self.topics: dict[str, TopicWatch] = {}

    def read(self, messages: Iterable[ScannedMessage]) -> None:
        """Take the messages of one file."""
        for message in messages:
            topic = message.channel.topic
            if topic not in self.topics:
                self.topics[topic] = TopicWatch(topic=topic)
            self.topics[topic].see(message, self.decoder)


def _find_ends(report: CheckReport, episode: Episode) -> None:
    """Say what ended a file before its time."""
    name = episode.path.name
    stopped_by = str(episode.record("recorder").get("stopped_by", ""))
    if stopped_by.startswith(BY_DISK):
        report.find("cut_short", name, f"ended by the {stopped_by}")
    if recovered := episode.record("recovered"):
        lost = recovered.get("bytes_lost", "an unknown number of")
        text = f"{recovered.get('reason', 'its recorder died')}; {lost} bytes were lost"
        report.find("recovered", name, text)


def _check_metadata(episode: Episode, faults: Faults) -> None:
    try:
        kind = episode.info.kind
        _ = episode.outcome, episode.derived  # raises when they cannot be read
    except BridgeError as error:
        faults.add(str(error))
        return
    if kind == "imported":
        return
    for topic, item in episode.topics().items():
        expected = type_of_topic(topic)
        if expected is None or not item.count or item.type_name in (expected, ""):
            continue
        images = {schema.IMAGE, schema.COMPRESSED_IMAGE, schema.COMPRESSED_VIDEO}
        if topic.endswith("/image") and expected in images and item.type_name in images:
            continue
        faults.add(f"{topic} carries {item.type_name}, expected {expected}")


def _judge_topics(
    report: CheckReport, episode: Episode | None, watch: _Watch, faults: Faults
) -> None:
    decoder = watch.decoder
    records = {} if episode is None else episode.metadata_records
    is_ours = episode is not None and episode.file.header.library.startswith(LIBRARY)
    ours = is_ours and records.get("episode", {}).get("kind") != "imported"
    is_recording = "recorder" in records
    say = faults.add if ours else report.notes.append
    report.notes += sorted(decoder.missing)
    shared = records.get("drops", {}).get("several_publishers")
    shared = shared if isinstance(shared, list) else []  # nobody knows whose number is whose
    for topic, topic_watch in sorted(watch.topics.items()):
        result = report.topics[topic] = topic_watch.finish()
        report.messages += result.messages
        result.declared_losses = decoder.drop_log.get(topic, 0)
        result.unnumbered = decoder.unnumbered.get(topic, 0)
        if result.undecodable:
            found = unreadable(topic, result.undecodable, result.messages, result.first_fault)
            report.findings.append(found)
            if ours:
                faults.add(f"{topic}: {found.text}")
        report.findings += topic_watch.findings(is_derived=episode is None or bool(episode.derived))
        if result.time_steps_back:
            text = f"{topic}: its log time steps back {result.time_steps_back} times"
            (say if is_recording else report.notes.append)(text)
        if decoder.has_drop_log and topic not in shared:
            missing = max(0, result.sequence_gaps - result.declared_losses)
            report.undeclared_losses += missing
            if missing:
                text = (
                    f"{result.sequence_gaps} numbers are missing, "
                    f"the drop log lists {result.declared_losses}"
                )
                report.find("drops_not_logged", topic, text)
    report.findings += decoder.findings
    for topic, lost in sorted(decoder.drop_log.items()):  # also of topics without any message
        if lost:
            report.findings.append(drops_logged(topic, lost))
    report.declared_losses = sum(decoder.drop_log.values())
    report.notes += unseen_losses(decoder.unnumbered)
    if isinstance(tails := records.get("drops", {}).get("uncounted_tails"), list) and tails:
        names = ", ".join(map(str, tails))
        report.notes.append(f"tail not known, nobody said how many were sent: {names}")
    unused = ", ".join(f"{topic} ({what})" for topic, what in sorted(decoder.unused.items()))
    report.notes += [f"kept, and no command reads them: {unused}"] if unused else []
    for text in decoder.size_faults():
        say(text)


def _judge_presence(
    report: CheckReport, episode: Episode, watch: _Watch, faults: Faults, contract: Contract | None
) -> None:
    records = episode.metadata_records
    if contract is None and RECORD_NAME in records:
        try:
            contract = contract_from(records[RECORD_NAME], name=episode.path.name)
        except ContractError as error:
            faults.add(str(error))
    recorder = records.get("recorder", {})
    start_ns, end_ns = recorder.get("start_ns"), recorder.get("end_ns")
    span = Span(
        start_ns if isinstance(start_ns, int) else episode.start_ns,
        end_ns if isinstance(end_ns, int) else episode.end_ns,
    )
    report.presences = {topic: found.presence for topic, found in watch.topics.items()}
    is_stand_in = records.get("episode", {}).get("stand_in") is True
    reports = judge(
        report.presences, contract, span, watch.decoder.drop_log, by_habit=not is_stand_in
    )
    for topic, found in reports.items():
        report.topics.setdefault(topic, TopicCheck()).presence = found
    untold = records.get("drops", {}).get("untold_tails")
    told = untold if isinstance(untold, list) else ()
    report.findings += findings_of(reports, report.presences, span.end_ns, told)
