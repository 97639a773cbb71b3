"""The recorder: messages and commands go in, episodes come out.

One writer thread does everything that touches the disk, in the order things arrived.
"""

import contextlib
import shutil
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, replace
from typing import Any

from bridge.clock import s_from_ns
from bridge.episode import metadata
from bridge.episode.catalogue import label_episode
from bridge.episode.run import RunFolder, check_episode_id
from bridge.errors import BridgeError, GstError, UsageError
from bridge.record.config import RecorderConfig
from bridge.record.errors import DiskError, LifecycleError
from bridge.record.intake import Command, Dropped, Entry, Intake, Received
from bridge.record.latched import LatchedMessages
from bridge.record.take import Take
from bridge.wire.session import WireSample

POLL_S = 0.25
Answer = dict[str, Any]


class Recorder:
    """Idle until ``start``; records one episode at a time into a run folder."""

    def __init__(
        self, run: RunFolder, *, now_ns: Callable[[], int], config: RecorderConfig | None = None
    ) -> None:
        """Start the writer thread.

        Args:
            run: Where episodes go.
            now_ns: The clock that also stamps received messages.
            config: Settings.
        """
        self.config = config or RecorderConfig()
        self.failed = threading.Event()
        self.error: DiskError | None = None
        self.last_episode: str | None = None
        self._run = run
        self._now_ns = now_ns
        self._intake = Intake(self.config)
        self._latched = LatchedMessages()
        self._seen: dict[str, int] = {}
        self._unwritable: set[str] = set()
        self._take: Take | None = None
        self._state_lock = threading.Lock()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="episode writer", daemon=True)
        self._thread.start()

    def receive(self, sample: WireSample) -> None:
        """Take a message from the network; never waits."""
        self._intake.put(sample)

    def start(self, info: metadata.EpisodeInfo) -> Answer:
        """Begin an episode.

        Raises:
            UsageError: When the id is unsafe, taken, or another episode is being recorded.
            BridgeError: When the folder cannot be written.
        """
        check_episode_id(info.id)
        return self._command(lambda stamp_ns: self._start(info, stamp_ns))

    def stop(
        self,
        *,
        outcome: metadata.Outcome | None = None,
        discard: bool = False,
        reason: str = "command",
    ) -> Answer:
        """Finish the episode, or throw it away, after everything received so far."""
        return self._command(
            lambda stamp_ns: self._stop(outcome, discard=discard, reason=reason, end_ns=stamp_ns)
        )

    def mark(self, text: str) -> Answer:
        """Note this instant in the episode."""
        return self._command(lambda stamp_ns: self._event("mark", stamp_ns, text, None))

    def label(
        self, *, text: str = "", outcome: metadata.Outcome | None = None, episode: str | None = None
    ) -> Answer:
        """Say how the open episode went, or, by its id, a finished one (kept under notes/)."""
        return self._command(lambda stamp_ns: self._label(stamp_ns, text, outcome, episode))

    def status(self) -> Answer:
        """What is going on; answers at once."""
        with self._state_lock:
            take = self._take
            answer: Answer = {
                "ok": self.error is None,
                "recorder": self.config.recorder,
                "run": str(self._run.path),
                "state": "failed" if self.error else "recording" if take else "idle",
                "error": str(self.error) if self.error else None,
                "episode": take.info.id if take else None,
                "last_episode": self.last_episode,
                "queue_bytes": self._intake.queued_bytes,
                "disk_free_bytes": shutil.disk_usage(self._run.path).free,
                "seen": dict(sorted(self._seen.items())),
            }
            if take is not None:
                answer["duration_s"] = s_from_ns(self._now_ns() - take.start_ns)
                answer.update(_counts(take))
                answer["topics"] = {
                    topic: asdict(tally) for topic, tally in take.ledger.totals().items()
                }
            return answer

    def close(self, reason: str = "the recorder was stopped") -> Answer | None:
        """Finish the open episode, if any, and end the writer thread."""
        answer = None
        if self._take is not None and self.error is None:
            with contextlib.suppress(LifecycleError):  # somebody stopped it at this moment
                answer = self.stop(reason=reason)
        self._closing = True
        self._intake.put_command(Command(action=lambda stamp_ns: None, received_ns=0))  # wake up
        self._thread.join(timeout=self.config.command_timeout_s)
        return answer

    # Below: the writer thread.

    def _command(self, act: Callable[[int], Answer]) -> Answer:
        if self.error is not None:
            raise self.error
        future: Future[Answer] = Future()

        def action(stamp_ns: int) -> None:
            try:
                future.set_result(act(stamp_ns))
            except GstError as error:
                future.set_exception(error)
            except OSError as error:
                future.set_exception(self._fail(error))
            except Exception as error:  # noqa: BLE001  # a bug: tell the caller, keep recording
                future.set_exception(error)

        self._intake.put_command(Command(action=action, received_ns=self._now_ns()))
        try:
            return future.result(timeout=self.config.command_timeout_s)
        except TimeoutError as error:
            raise BridgeError(
                f"the recorder did not finish within {self.config.command_timeout_s:g} s; "
                "the disk is too slow or the queue very long. Ask for its status."
            ) from error

    def _work(self) -> None:
        while True:
            entry = self._intake.get(0.0 if self._closing else POLL_S)
            with self._state_lock:
                try:
                    self._handle(entry)
                except OSError as error:
                    self._fail(error)
            if entry is None and self._closing:
                return

    def _handle(self, entry: Entry | None) -> None:
        if isinstance(entry, Received):
            self._notice(entry.sample)
            if self._take is not None:
                self._write(self._take, entry)
        elif isinstance(entry, Dropped):
            if self._take is not None:
                self._take.count_dropped(entry)
        elif isinstance(entry, Command):
            entry.action(entry.received_ns)
        if self._take is not None:
            self._take.tick(self._now_ns())

    def _write(self, take: Take, entry: Received) -> None:
        """One message that cannot be written is counted as lost; recording goes on."""
        try:
            take.write(entry)
        except OSError:
            raise
        except Exception:  # noqa: BLE001  # a bug, or a message nobody thought of
            if entry.sample.topic not in self._unwritable:
                self._unwritable.add(entry.sample.topic)
                traceback.print_exc()
            take.ledger.count_refused(entry)

    def _notice(self, sample: WireSample) -> None:
        self._latched.remember(sample)
        if sample.topic in self._seen or len(self._seen) < self.config.max_topics:
            self._seen[sample.topic] = self._seen.get(sample.topic, 0) + 1

    def _start(self, info: metadata.EpisodeInfo, stamp_ns: int) -> Answer:
        if self._closing:
            raise LifecycleError("the recorder is ending. Start it again for another episode.")
        if self._take is not None:
            raise LifecycleError(
                f"episode {self._take.info.id!r} is being recorded. Stop it before {info.id!r}."
            )
        path = self._run.episodes_dir / f"{info.id}.mcap"
        part_path = path.with_name(path.name + ".part")
        if part_path.exists():
            raise UsageError(
                f"{part_path} is left from a take that was cut off. "
                "Move it away or recover it, or choose another episode id."
            )
        take = Take(path, info, self.config, stamp_ns)
        self._take = take
        take.write_latched(self._latched.all())
        return {"ok": True, "episode": info.id}

    def _open_take(self) -> Take:
        if self._take is None:
            raise LifecycleError("nothing is being recorded. Start an episode first.")
        return self._take

    def _stop(
        self, outcome: metadata.Outcome | None, *, discard: bool, reason: str, end_ns: int
    ) -> Answer:
        take = self._open_take()
        if discard:
            take.discard()
        else:
            take.close(end_ns=end_ns, reason=reason, outcome=outcome)
            self.last_episode = take.info.id
        self._take = None
        return {
            "ok": True,
            "episode": take.info.id,
            "discarded": discard,
            "duration_s": s_from_ns(end_ns - take.start_ns),
            **_counts(take),
        }

    def _event(
        self, kind: str, stamp_ns: int, text: str, outcome: metadata.Outcome | None
    ) -> Answer:
        take = self._open_take()
        take.write_event(kind, stamp_ns=stamp_ns, text=text, outcome=outcome)
        return {"ok": True, "episode": take.info.id}

    def _label(
        self, stamp_ns: int, text: str, outcome: metadata.Outcome | None, episode: str | None
    ) -> Answer:
        is_open = self._take is not None and episode in (None, self._take.info.id)
        if is_open:
            return self._event("label", stamp_ns, text, outcome)
        name = episode or self.last_episode
        if name is None:
            raise LifecycleError("there is no episode to label yet. Record one, or name one.")
        if outcome is None:
            raise LifecycleError(
                f"episode {name!r} is finished; only a result can be added to it. "
                "Give one: success, failure or unknown."
            )
        if text and not outcome.detail:
            outcome = replace(outcome, detail=text)
        note = label_episode(self._run, name, outcome)
        return {"ok": True, "episode": name, "note": str(note)}

    def _fail(self, error: OSError) -> DiskError:
        part_path = self._take.part_path if self._take else self._run.episodes_dir
        self.error = DiskError(part_path=part_path, cause=error.strerror or str(error))
        if self._take is not None:
            self._take.abandon()
            self._take = None
        self.failed.set()
        return self.error


def _counts(take: Take) -> Answer:
    total = take.ledger.total()
    return {
        "messages": total.received,
        "bytes": total.bytes,
        "lost": total.gaps + total.queue_drops,
        "undecodable": total.undecodable,
        "unknown_type": total.unknown_type,
    }
