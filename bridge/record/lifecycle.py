"""What the recorder is doing: idle, recording, finishing; and the steps between. One thread."""

import contextlib
import errno
import os
import tempfile
import traceback
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bridge.clock import s_from_ns
from bridge.episode import metadata
from bridge.episode.catalogue import sidecar_path
from bridge.episode.contract import Contract
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.record.config import BYTES_PER_MB, RecorderConfig
from bridge.record.episode_recording import EpisodeRecording
from bridge.record.errors import DiskError, LifecycleError, NoSpaceError
from bridge.record.presence import News
from bridge.record.queue import Command, Dropped, Item, LatchedMessages, LatchedTopics
from bridge.task.task_file import TaskFile


class DiskReserve:
    """An allocated file without a name: it vanishes with the process, whatever ends it."""

    def __init__(self, folder: Path, size_mb: int) -> None:
        """Choose where and how much; nothing is allocated yet."""
        self._folder = folder
        self._bytes = size_mb * BYTES_PER_MB
        self._descriptor: int | None = None

    @property
    def held_bytes(self) -> int:
        """What comes back when it is released."""
        return 0 if self._descriptor is None else self._bytes

    def hold(self) -> None:
        """Allocate it, if it is not yet."""
        if self._descriptor is not None or not self._bytes:
            return
        try:
            descriptor = _nameless(self._folder)
        except OSError:  # the folder cannot be written: creating the episode says so better
            return
        try:
            os.posix_fallocate(descriptor, 0, self._bytes)
        except OSError as error:
            os.close(descriptor)
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise NoSpaceError(
                    folder=self._folder, free_mb=0, wanted_mb=self._bytes // BYTES_PER_MB
                ) from error
            return  # a file system or a limit that allows none: record without
        self._descriptor = descriptor

    def release(self) -> None:
        """Give the space back to the disk."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _nameless(folder: Path) -> int:
    if hasattr(os, "O_TMPFILE"):
        with contextlib.suppress(OSError):  # some file systems have no such files
            return os.open(folder, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
    descriptor, name = tempfile.mkstemp(prefix=".reserve-", dir=folder)
    Path(name).unlink()
    return descriptor


def free_bytes(folder: Path) -> int:
    """What an ordinary user may still write there."""
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


Answer = dict[str, Any]
UNANSWERED_S = 1.0
"""A disk that has been at one write for so long is not asked for anything else [s]."""


class Lifecycle:
    """Decides what happens to each message, and carries out commands."""

    def __init__(
        self,
        run: RunFolder,
        config: RecorderConfig,
        queued_bytes: Callable[[], int],
        latched: LatchedTopics,
    ) -> None:
        """Begin idle."""
        self.take: EpisodeRecording | None = None
        self.is_closing = False
        self.is_finishing = False
        self.error: DiskError | None = None
        self.last_episode: str | None = None
        self.latched = LatchedMessages(latched)
        self.others: dict[str, Callable[[], object]] = {}
        """What others have to say of each episode, by name."""
        self.contract: Contract | None = None
        """What the topics of the next episode promise."""
        self.earlier_clocks: Callable[[], list[Answer]] = list
        """Readings of the sources' clocks made before an episode."""
        self.answering: Callable[[], set[str]] = set
        self._reserve = DiskReserve(run.episodes_dir, config.disk.reserve_mb)
        self.free_bytes = free_bytes(run.path)
        self._run = run
        self._config = config
        self._queued_bytes = queued_bytes
        self._unwritable: set[str] = set()

    @property
    def is_quiet(self) -> bool:
        """Say whether messages are of no use now, but for what is latched."""
        return self.take is None

    @property
    def keeps_up(self) -> bool:
        """Whether the disk may be given images; small messages it is given at any time."""
        return self.take is None or self.take.keeps_up

    @property
    def state(self) -> str:
        """One word."""
        if self.error is not None:
            return "failed"
        if self.take is None:
            return "idle"
        return "finishing" if self.is_finishing else "recording"

    def _health(self) -> dict[str, int]:
        return {"queue_bytes": self._queued_bytes(), "disk_free_bytes": self.free_bytes}

    def receive(self, entry: Item | Dropped) -> None:
        """Write, keep where it is latched, or leave out."""
        if isinstance(entry, Item):
            self.latched.remember(entry.sample)
            if self.take is not None:
                self._write(self.take, entry)
        elif self.take is not None:
            self.take.ledger.count_dropped(entry)

    def _write(self, take: EpisodeRecording, item: Item) -> None:
        """One message that cannot be written is counted as lost; recording goes on."""
        try:
            take.write(item)
        except OSError:
            raise
        except Exception:  # noqa: BLE001  # a bug, or a message nobody thought of
            if item.sample.topic not in self._unwritable:
                self._unwritable.add(item.sample.topic)
                traceback.print_exc()
            take.ledger.count_refused(item)

    def tick(self, now_ns: int) -> None:
        """Do what time asks for: flush, close seconds. Raises OSError for the disk."""
        if self.take is not None:
            self.take.tick(now_ns, self._health())

    def take_news(self) -> list[News]:
        """What the open episode has noticed since the last call."""
        if self.take is None:
            return []
        news, self.take.news = self.take.news, []
        return news

    @property
    def may_ask_disk(self) -> bool:
        """Whether the disk answers, so that asking it for names and space holds nobody up."""
        return self.take is None or self.take.disk["busy_s"] < UNANSWERED_S

    def look_at_disk(self) -> str:
        """Return why the open episode must end now, or ""; raise OSError where its file is gone."""
        if self.take is not None:
            self.take.writer.refuse_removed()
        lacks, free_mb, min_mb = self._space()
        if self.take is None or not lacks:
            return ""
        return f"only {free_mb} MB are free, and {min_mb} MB must be left"

    def _space(self) -> tuple[bool, int, int]:
        """Whether too little space is free, how much is, and how much must be left [MB]."""
        self.free_bytes = free_bytes(self._run.path) + self._reserve.held_bytes
        min_mb = self._config.disk.min_free_mb
        return self.free_bytes < min_mb * BYTES_PER_MB, self.free_bytes // BYTES_PER_MB, min_mb

    def note_clock_step(self, step_ns: int, now_ns: int) -> None:
        """Write down that the system clock has jumped."""
        if self.take is not None:
            self.take.note_clock_step(step_ns, stamp_ns=now_ns)

    # Commands

    def start(
        self, info: metadata.EpisodeInfo, command: Command, task: TaskFile | None = None
    ) -> Answer:
        """Begin an episode."""
        self._refuse_start(info.id)
        self._reserve.hold()
        self.take = EpisodeRecording(
            self._run.episodes_dir,
            info,
            self._config,
            start_ns=command.received_ns,
            latched=self.latched.all,
            others=self.others,
            contract=self.contract,
            task=task,
            clocks=self.earlier_clocks(),
        )
        self.take.ledger.answering = self.answering
        self.take.ledger.begin(command.ticket)
        return {"ok": True, "episode": info.id}

    def _refuse_start(self, episode_id: str) -> None:
        if self.is_closing:
            raise LifecycleError("the recorder is ending. Start it again for another episode.")
        if self.take is not None:
            raise LifecycleError(
                f"episode {self.take.info.id!r} is being recorded. Stop it before {episode_id!r}."
            )
        left = next(self._run.episodes_dir.glob(f"{episode_id}.*part"), None)
        if left is not None:
            raise UsageError(
                f"{left} is being written, or left from a take that was cut off. "
                "Recover it or move it away, or choose another episode id."
            )
        if (label := sidecar_path(self._run, episode_id)).is_file():
            how = "Choose another name, or move it away."
            raise UsageError(f"{label} is the label of an earlier {episode_id}. {how}")
        lacks, free_mb, min_mb = self._space()
        if lacks:
            raise NoSpaceError(folder=self._run.path, free_mb=free_mb, wanted_mb=min_mb)

    def _open_take(self) -> EpisodeRecording:
        if self.take is None:
            raise LifecycleError("nothing is being recorded. Start an episode first.")
        return self.take

    def stop(
        self, outcome: metadata.Outcome | None, command: Command, *, discard: bool, reason: str
    ) -> Answer:
        """Finish the episode, or throw it away."""
        take = self._open_take()
        end_ns = command.received_ns
        self.is_finishing = True
        if discard:
            take.discard()
        else:
            take.close(end_ns=end_ns, reason=reason, outcome=outcome, health=self._health())
            self.last_episode = take.info.id
        self.take = None
        self.is_finishing = False
        answer = {"ok": True, "episode": take.info.id, "discarded": discard}
        answer["duration_s"] = s_from_ns(end_ns - take.start_ns)
        return {**answer, **counts(take), "uncounted_tails": take.ledger.uncounted_tails()}

    def event(
        self, kind: str, command: Command, text: str, outcome: metadata.Outcome | None
    ) -> Answer:
        """Note this instant in the episode."""
        take = self._open_take()
        take.write_event(kind, stamp_ns=command.received_ns, text=text, outcome=outcome)
        return {"ok": True, "episode": take.info.id}

    def fail(
        self,
        cause: str,
        now_ns: int,
        rest: Callable[[], Iterable[Item | Dropped]],
        *,
        in_reserve: bool = False,
    ) -> DiskError:
        """End a recording the disk has refused, and finish its file if there is any way."""
        take = self.take
        path = take.writer.part_path if take else self._run.episodes_dir
        error = DiskError(path=path, cause=cause, is_finished=False)
        reason = f"{metadata.IN_RESERVE if in_reserve else metadata.BY_DISK}{cause}"
        if take is None:
            self.error = error
            return error
        if not self.is_finishing:  # else they are of the time after its end
            take.refuse(rest())
        self._reserve.release()
        take.ledger.answering = tuple  # nobody was asked
        try:
            take.close(end_ns=now_ns, reason=reason, outcome=None, health=self._health())
            error = DiskError(path=take.writer.path, cause=cause, is_finished=True)
            self.last_episode = take.info.id
        except OSError:
            take.abandon()
        self.error = error
        self.take = None
        self.is_finishing = False
        return error

    def end(self) -> None:
        """Let go of the disk space held back."""
        with contextlib.suppress(OSError):
            self._reserve.release()


def counts(take: EpisodeRecording) -> Answer:
    """What an episode holds and lacks so far."""
    total = take.ledger.total()
    return {
        "messages": total.received,
        "bytes": total.bytes,
        "lost": total.lost,
        "undecodable": total.undecodable,
        "unknown_type": total.unknown_type,
        "unnumbered": take.ledger.unnumbered(),
        "findings": [asdict(finding) for finding in take.findings()],
    }
