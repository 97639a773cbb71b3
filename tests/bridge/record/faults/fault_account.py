"""What a file holds, by the official reader, against what its sender says."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from fault_cell import FaultCell, PublisherChild, Sent
from mcap.reader import make_reader

import robot_gst
from bridge.episode.topics import CLOCKS, DROPS

LOSSES = ("gaps", "queue_drops")
TAIL_S = 0.5


class Found(NamedTuple):
    """One message of a file."""

    topic: str
    sequence: int
    digest: str
    log_ns: int
    schema_name: str
    channel_id: int


def read(path: Path) -> list[Found]:
    """Every message in file order, all CRCs checked, our own records left out."""
    with path.open("rb") as stream:
        return [
            Found(
                channel.topic,
                message.sequence,
                hashlib.sha256(message.data).hexdigest(),
                message.log_time,
                kind.name if kind else "",
                channel.id,
            )
            for kind, channel, message in make_reader(stream, validate_crcs=True).iter_messages(
                log_time_order=False
            )
            if channel.topic not in (CLOCKS, DROPS) and not channel.topic.endswith("/event")
        ]


def metadata(path: Path, name: str) -> dict[str, Any]:
    with path.open("rb") as stream:
        records = make_reader(stream, validate_crcs=True).iter_metadata()
        found = next(record.metadata for record in records if record.name == name)
    return {key: json.loads(value) for key, value in found.items()}


def ledger(path: Path) -> dict[str, dict[str, int]]:
    """The accounts of each topic; the seconds in the file must add up to them."""
    topics: dict[str, dict[str, int]] = metadata(path, "drops")["topics"]
    names = ("received", "repeated", "undecodable", *LOSSES)
    summed = {topic: Counter(dict.fromkeys(names, 0)) for topic in topics}
    with path.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=[DROPS]):
            record = json.loads(message.data)
            for name in names:
                summed[record["topic"]][name] += record[name]
    totals = {topic: {name: tally[name] for name in names} for topic, tally in topics.items()}
    assert totals == {topic: dict(counts) for topic, counts in summed.items()}
    return topics


def lost(tally: dict[str, int]) -> int:
    return sum(tally[name] for name in LOSSES)


def check_code(path: Path) -> int:
    """The exit code of ``robot-gst check``."""
    return robot_gst.run(["check", str(path), "--quiet"])


def beginnings(found: list[Found], sent: list[Sent]) -> dict[str, int]:
    """The number of each topic's messages, which are its first ones without holes."""
    kept = {}
    for topic in {item.topic for item in sent}:
        numbers = [item.sequence for item in found if item.topic == topic]
        assert numbers == list(range(len(numbers))), topic
        kept[topic] = len(numbers)
    return kept


def only_the_tail_is_missing(
    found: list[Found], sent: list[Sent], writes: Path, killed_ns: int
) -> None:
    """Of each topic a beginning without holes, up to less than a kill may cost.

    The recorder writes at least each half second, and all that came half a second before a write.
    ``writes`` (slow_recorder.py) says when it wrote, and how long its writing thread was away on a
    busy machine: messages may wait as long to be taken, their chunk to be closed and written.
    """
    times: dict[str, list[int]] = {"tick": [], "began": [], "ended": []}
    for what, at_ns in map(str.split, writes.read_text().splitlines()):
        times[what].append(int(at_ns))
    begun, ended = times["began"], times["ended"]
    away_ns = max(after - before for before, after in pairwise([*times["tick"], killed_ns]))
    limit_ns = 1e9 * TAIL_S + 3 * away_ns
    left = [(item, after.put_ns) for item, after in pairwise(sent)]  # by then it had been put
    before_ns = begun[len(ended) - 1] - limit_ns
    for topic, kept in beginnings(found, sent).items():
        old = sum(item.topic == topic and left_ns < before_ns for item, left_ns in left)
        assert kept >= old, f"{topic}: {kept} of {old} in the file"
    if len(begun) == len(ended):
        late = [item for item, left_ns in left if ended[-1] < left_ns < killed_ns - limit_ns]
        assert not late, f"no write for {(killed_ns - ended[-1]) / 1e9:.3f} s"


def nothing_invented(
    found: Iterable[Found], sent: Iterable[Sent], *, transcoded: tuple[str, ...] = ()
) -> None:
    """Law: each message of the file was sent, with these bytes, and as often."""
    in_file = Counter(
        (item.topic, item.sequence, "" if item.topic in transcoded else item.digest)
        for item in found
    )
    on_wire = Counter(
        (item.topic, item.sequence or 0, "" if item.topic in transcoded else item.digest)
        for item in sent
    )
    strange = in_file - on_wire
    assert not strange, strange.most_common(5)


def accounts_are_exact(
    path: Path, sent: list[Sent], *, transcoded: tuple[str, ...] = ()
) -> dict[str, dict[str, int]]:
    """Law: of each topic, different messages sent = received - repeated + declared losses."""
    found = read(path)
    nothing_invented(found, sent, transcoded=transcoded)
    topics = ledger(path)
    in_file = Counter(item.topic for item in found)
    assert {topic: tally["received"] for topic, tally in topics.items()} == {
        topic: in_file[topic] for topic in topics
    }
    different = Counter(topic for topic, *_ in {(s.topic, s.gid, s.sequence) for s in sent})
    said = {
        topic: tally["received"] - tally["repeated"] + lost(tally)
        for topic, tally in topics.items()
    }
    assert said == different, {t: (said.get(t), different.get(t)) for t in {*said, *different}}
    return topics


class LiveCell:
    """One recorder and one publisher; each test records an episode with them."""

    def __init__(self, cell: FaultCell, publisher: PublisherChild) -> None:
        """Use the fixture ``live``."""
        self.cell = cell
        self.publisher = publisher
        self._before = 0

    def start(self, episode: str) -> None:
        self._before = len(self.publisher.sent())
        answer = self.publisher.ask("start", {"id": episode, "info": {"cell": "cell"}})
        assert answer.get("ok"), answer

    def stop(self) -> dict[str, Any]:
        answer = self.publisher.ask("stop")
        assert answer.get("ok"), answer
        stopped: dict[str, Any] = answer["ok"]
        return stopped

    def put(self, *puts: dict[str, Any]) -> None:
        self.publisher.tell(puts=puts)
        self.publisher.answer()

    def sent(self) -> list[Sent]:
        """What was sent since the last start."""
        return self.publisher.sent()[self._before :]

    def path(self, episode: str) -> Path:
        return self.cell.path(episode)
