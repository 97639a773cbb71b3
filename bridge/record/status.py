"""What is going on, for whoever asks: answered from memory, never waiting for disk or queue."""

import time
from collections.abc import Callable
from typing import Any

from bridge.clock import s_from_ns
from bridge.episode.contract import health_lines
from bridge.episode.health import in_words
from bridge.episode.run_folder import RunFolder
from bridge.record.config import RecorderConfig
from bridge.record.errors import in_short
from bridge.record.lifecycle import Lifecycle, counts
from bridge.record.presence import Silence
from bridge.record.queue import InputQueue

SLOW_LAG_S = 0.5
"""A status line says so when small messages have waited longer than this for the disk."""
FAR_CLOCK_MS = 50.0
"""A status line names clocks that are further from the recorder's."""
STALLED_S = 1.0
"""A writer that has not moved for this long is waiting for its disk."""


class Status:
    """Collects what the parts of a recorder say of themselves."""

    def __init__(
        self,
        run: RunFolder,
        config: RecorderConfig,
        input_queue: InputQueue,
        life: Lifecycle,
        now_ns: Callable[[], int],
        presence: Callable[[], dict[str, Any]],
    ) -> None:
        """Remember whom to ask; ``presence`` says which topics are silent."""
        self._presence = presence
        self.failing = ""
        """What the disk said, while the episode is still being finished."""
        self.clock_steps = 0
        self.others: dict[str, Callable[[], object]] = {}
        self._run = run
        self._config = config
        self._input_queue = input_queue
        self._life = life
        self._now_ns = now_ns
        self._beat_s = time.monotonic()
        self._counted: tuple[int, dict[str, int]] = (now_ns(), {})
        self._rates_hz: dict[str, float] = {}

    def beat(self) -> None:
        """Note that the writer thread is moving."""
        self._beat_s = time.monotonic()

    def second(self, now_ns: int) -> None:
        """Work out the rates since the last call; called about once a second."""
        before_ns, before = self._counted
        seen = self._input_queue.seen()
        span_s = max(1e-9, s_from_ns(now_ns - before_ns))
        self._rates_hz = {
            topic: round((count - before.get(topic, 0)) / span_s, 1)
            for topic, count in seen.items()
        }
        self._counted = (now_ns, seen)

    def answer(self) -> dict[str, Any]:
        """Say everything, as JSON values."""
        life = self._life
        take = life.take  # the writer thread may put another one there at any time
        error = str(life.error) if life.error else self.failing or None
        disk = take.disk if take else {"write_lag_s": 0.0, "busy_s": 0.0}
        stalled_s = max(time.monotonic() - self._beat_s, disk["busy_s"])
        answer: dict[str, Any] = {
            "ok": error is None,
            "recorder": self._config.recorder,
            "run": str(self._run.path),
            "state": "failed" if error else life.state,
            "error": error,
            "episode": take.info.id if take else None,
            "last_episode": life.last_episode,
            "queue_bytes": self._input_queue.queued_bytes,
            "disk_free_bytes": life.free_bytes,
            "write_lag_s": round(disk["write_lag_s"], 2),
            "stalled_s": round(stalled_s, 1) if stalled_s > STALLED_S else 0.0,
            "clock_steps": self.clock_steps,
            "seen": self._input_queue.seen(),
            "rates_hz": self._rates_hz,
        }
        answer.update(self._presence())
        answer.update({name: ask() for name, ask in self.others.items()})
        if take is not None:
            answer["duration_s"] = s_from_ns(self._now_ns() - take.start_ns)
            answer.update(counts(take))
            totals = take.ledger.totals()
            answer["topics"] = {topic: tally.to_record() for topic, tally in totals.items()}
            answer["warnings"] = list(take.ledger.warnings)
        return answer


def describe_status(status: dict[str, Any], rate_hz: float | None = None) -> str:
    """One line about a recorder."""
    free = f"{status['disk_free_bytes'] / 1e9:.1f} GB free"
    if status["state"] == "failed":
        return f"failed: {status['error']}"
    stalled = f", the disk has not answered for {s:.0f} s" if (s := status["stalled_s"]) else ""
    if (lag_s := status["write_lag_s"]) > SLOW_LAG_S:
        stalled += f", small messages wait {lag_s:.1f} s for the disk"
    stalled += _hearing(status)
    if status["state"] == "idle":
        return f"idle, {len(status['seen'])} topics seen, {free}{stalled}"
    rate = "" if rate_hz is None else f" ({rate_hz:.0f}/s)"
    flags = "".join(
        f", {status[name]} {name.replace('_', ' ')}"
        for name in ("undecodable", "unknown_type")
        if status[name]
    )
    if status.get("findings"):
        found = [f"{in_words(each['name'])} on {each['about']}" for each in status["findings"]]
        flags += f", {in_short(found)}"
    return (
        f"{status['state']} {status['episode']}: {status['duration_s']:.1f} s, "
        f"{status['messages']} messages{rate}, {status['bytes'] / 1e6:.1f} MB, "
        f"{status['lost']} lost{flags}, queue {status['queue_bytes'] / 1e6:.1f} MB, "
        f"{free}{stalled}"
    )


def _hearing(status: dict[str, Any]) -> str:
    """Which topics are silent or missing, and whether the recorder hears at all."""
    told = ""
    if status["deaf_s"]:
        told += f", DEAF: the recorder has not heard even itself for {status['deaf_s']:.1f} s"
    if status.get("receive_errors"):
        told += f", {status['receive_errors']} messages could not be received"
    for clock in status.get("clocks", ()):
        if abs(clock["offset_ms"]) > FAR_CLOCK_MS:
            side = "ahead" if clock["offset_ms"] > 0 else "behind"
            offset_s = abs(clock["offset_ms"]) / 1e3
            told += f", clock of {clock['source']} on {clock['host']} {offset_s:.3g} s {side}"
    silent = [Silence(**silence) for silence in status["silent"]]
    named = {silence.topic for silence in silent}
    missing = [text for text in status["missing"] if text.split(" ")[0] not in named]
    words = [*map(str, silent), *missing]
    if words:
        told += f", {in_short(words)}"
    return told


def describe_answer(answer: dict[str, Any]) -> str:
    """One line about the answer to a command, and one for each topic that was not there."""
    if answer.get("discarded"):
        return f"{answer['episode']}: discarded"
    if "messages" in answer:
        line = (
            f"{answer['episode']}: {answer['messages']} messages, {answer['lost']} lost, "
            f"{answer['undecodable']} undecodable, {answer['duration_s']:.1f} s"
        )
        return "\n  ".join([line, *health_lines(answer)])
    remark = f"; {text}" if (text := answer.get("task_remark")) else ""
    if answer.get("missing"):
        remark += f", although {in_short(answer['missing'])}"
    return f"{answer['episode']}: ok{remark}"
