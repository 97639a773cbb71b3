"""Who publishes, on which host, and what its clock says: announced by sources, asked by recorders.

A source answers queries on ``@clock/<prefix>`` with JSON: when the query came and when the answer
left, by the clock of its stamps. ``docs/wire.md`` is the contract for other programs.
"""

import contextlib
import json
import socket
from typing import NamedTuple

from bridge.episode.clocks import Reading, read_round_trip
from bridge.wire.keys import key_from_topic
from bridge.wire.session import WireSession

CLOCKS = "@clock"
ALIVE = "/alive"
MAX_TOPICS = 1000


class ClockAnswer(NamedTuple):
    """What one source said."""

    source: str
    identity: str
    """Of its process; "" where it did not say."""
    host: str
    topics: frozenset[str]
    reading: Reading


def announce(session: WireSession, *prefixes: str) -> None:
    """Let everybody see that a source is there, and ask its clock, until the session closes."""

    def answer(request: bytes) -> bytes:
        received_ns = session.now_ns()
        about = {
            "schema_version": 1,
            "id": session.identity,
            "host": socket.gethostname(),
            "topics": sorted(session.topics)[:MAX_TOPICS],
        }
        times = {"received_ns": received_ns, "sent_ns": session.now_ns()}
        return json.dumps({**about, **times}).encode()

    session.serve(f"{CLOCKS}/{key_from_topic(f'/{prefixes[0]}')}", answer)
    for prefix in prefixes:  # last: whoever sees it can ask
        session.declare_alive(f"{prefix}{ALIVE}")


def ask_clocks(session: WireSession, *, timeout_s: float) -> list[ClockAnswer]:
    """Ask every source for its clock; answers that make no sense are left out."""
    asked_ns = session.now_ns()
    answers = []
    for sample in session.query_all(f"{CLOCKS}/**", timeout_s=timeout_s, max_mb=1):
        source = sample.topic.removeprefix(f"/{CLOCKS}/")
        with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):
            record = json.loads(sample.data)
            reading = read_round_trip(
                asked_ns=asked_ns,
                received_ns=int(record["received_ns"]),
                sent_ns=int(record["sent_ns"]),
                back_ns=sample.received_ns,
            )
            answers.append(
                ClockAnswer(
                    source=source,
                    identity=str(record.get("id", ""))[:64],
                    host=str(record.get("host", "an unnamed host"))[:200],
                    topics=frozenset(map(str, list(record.get("topics", ()))[:MAX_TOPICS])),
                    reading=reading,
                )
            )
    return answers
