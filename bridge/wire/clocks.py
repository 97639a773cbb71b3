"""Who publishes, on which host, what its clock says and how many messages it has sent.

A source answers queries of recorders on ``@clock/<prefix>`` with JSON, and gives a last answer
with a query of its own on ``@sent/<prefix>``. ``docs/wire.md`` is the contract for other programs.
"""

import contextlib
import json
import socket
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from bridge.episode.clocks import Reading, read_round_trip
from bridge.wire.keys import key_from_topic
from bridge.wire.publisher import GID_BYTES
from bridge.wire.session import Service, WireSession

CLOCKS, LAST = "@clock", "@sent"
ALIVE = "/alive"
MAX_TOPICS = 1000
MAX_MB = 1
"""All answers together; one with ``MAX_TOPICS`` has about a tenth of it [MB]."""

Sent = Mapping[tuple[str, bytes], int]
"""By topic and publisher id, how many messages were sent."""


class ClockAnswer(NamedTuple):
    """What one source said."""

    source: str
    identity: str
    """Of its process; "" where it did not say."""
    host: str
    topics: frozenset[str]
    reading: Reading | None
    """None of one whose stamps are not its host's clock."""
    sent: Sent


def announce(session: WireSession, *prefixes: str, has_clock: bool = True) -> None:
    """Let everybody see that a source is there, and ask it, until the session closes.

    ``has_clock`` is False where the stamps are not those of this host's clock.
    """

    def answer(request: bytes) -> bytes:
        received_ns, sent = session.now_ns(), session.sent()
        about = {
            "schema_version": 1,
            "id": session.identity,
            "host": socket.gethostname(),
            "topics": sorted(sent)[:MAX_TOPICS],
            "sent": dict(list(sent.items())[:MAX_TOPICS]),
        }
        times = {"received_ns": received_ns, "sent_ns": session.now_ns()} if has_clock else {}
        return json.dumps({**about, **times}).encode()

    name = key_from_topic(f"/{prefixes[0]}")
    session.serve(f"{CLOCKS}/{name}", answer)
    session.say_last(f"{LAST}/{name}", answer)
    for prefix in prefixes:  # last: whoever sees it can ask
        session.declare_alive(f"{prefix}{ALIVE}")


def ask_clocks(
    session: WireSession, *, timeout_s: float, is_last: bool = False
) -> list[ClockAnswer]:
    """Ask every source; answers that make no sense are left out.

    ``is_last``: all that a source counts has been received, or is lost, when its answer comes.
    """
    asked_ns, answers = session.now_ns(), []
    asked = f"{CLOCKS}/**"
    for sample in session.query_all(asked, timeout_s=timeout_s, max_mb=MAX_MB, is_last=is_last):
        with contextlib.suppress(*_NO_SENSE):
            record = json.loads(sample.data)
            reading = None
            if "received_ns" in record or "sent" not in record:
                reading = read_round_trip(
                    asked_ns=asked_ns,
                    received_ns=int(record["received_ns"]),
                    sent_ns=int(record["sent_ns"]),
                    back_ns=sample.received_ns,
                )
            answers.append(
                ClockAnswer(
                    source=sample.topic.removeprefix(f"/{CLOCKS}/"),
                    identity=str(record.get("id", ""))[:64],
                    host=str(record.get("host", "an unnamed host"))[:200],
                    topics=frozenset(map(str, list(record.get("topics", ()))[:MAX_TOPICS])),
                    reading=reading,
                    sent=_counts(record.get("sent", {})),
                )
            )
    return answers


def hear_last_words(session: WireSession, told: Callable[[Sent], None]) -> Service:
    """Hear of sources that end what they have sent."""

    def hear(words: bytes) -> bytes:
        with contextlib.suppress(*_NO_SENSE):
            told(_counts(json.loads(words)["sent"]))
        return b""

    return session.serve(f"{LAST}/**", hear)


_NO_SENSE = (ValueError, KeyError, TypeError, AttributeError, RecursionError)


def _counts(record: Any) -> Sent:
    counts = {}
    for topic, publishers in record.items():
        for gid, count in publishers.items():
            key = topic, bytes.fromhex(gid)
            if len(key[1]) != GID_BYTES or type(count) is not int or not 0 <= count < 2**63:
                raise ValueError(count)
            counts[key] = count
            if len(counts) > MAX_TOPICS:
                raise ValueError(len(counts))
    return counts
