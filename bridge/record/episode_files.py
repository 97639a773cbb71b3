"""The files of one episode while it is being recorded: parts, one after the other.

Used by the writer thread only. Another disk takes over where one fails.
"""

import contextlib
import json
import threading
from pathlib import Path

from bridge.clock import ns_from_s
from bridge.episode.contract import RECORD_NAME, Contract
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import part_name
from bridge.episode.writer import EpisodeWriter, WriterConfig
from bridge.errors import BridgeError
from bridge.record.config import BYTES_PER_MB, DiskConfig
from bridge.task.find import ATTACHMENT, MEDIA_TYPE
from bridge.task.task_file import TaskFile

"""Of the metadata record of a part that lies on another disk than the parts before."""


class EpisodeFiles:
    """Opens one part after the other; a full one is finished on a thread of its own."""

    def __init__(
        self,
        folder: Path,
        info: EpisodeInfo,
        config: DiskConfig,
        now_ns: int,
        contract: Contract | None,
        task: TaskFile | None,
    ) -> None:
        """Create the first part.

        Args:
            now_ns: When the first part begins [ns], by the recorder's clock.
            contract: What the topics promise; each part holds it.

        Raises:
            UsageError: When the episode exists, or is being written.
            BridgeError: When the folder cannot be written.
        """
        self._folder = folder
        self._first_path = folder / part_name(info.id, 1)
        self._info = info
        self._contract = contract
        self._task = task
        self._split_bytes = config.split_mb * BYTES_PER_MB
        self._split_ns = ns_from_s(config.split_s)
        self._is_split = bool(config.split_mb or config.split_s)
        self._config = WriterConfig(
            flush_s=config.flush_s, sync_s=config.sync_s, backlog_bytes=config.backlog_bytes
        )
        self._full: list[EpisodeWriter] = []
        self._finisher: threading.Thread | None = None
        self._error: OSError | None = None
        self._paths: list[Path] = []
        self._said: EpisodeWriter | None = None
        self.index = 1
        self.writer = self._open(now_ns)

    @property
    def first_path(self) -> Path:
        """The finished first file; its name is the episode's."""
        return self._first_path

    @property
    def open_path(self) -> Path:
        """The file that is being written."""
        return self.writer.part_path

    def _open(self, now_ns: int) -> EpisodeWriter:
        path = self._folder / part_name(self._info.id, self.index)
        self._opened_ns = now_ns
        writer = EpisodeWriter(path, config=self._config)
        try:
            self._say_what_it_is(writer)
        except OSError as error:
            writer.discard()
            raise BridgeError(
                f"cannot write {writer.part_path}: {error.strerror}. Choose another folder."
            ) from error
        self._paths.append(path)
        return writer

    def _say_what_it_is(self, writer: EpisodeWriter) -> None:
        writer.describe(self._info)
        if self._contract is not None:
            writer.add_metadata(RECORD_NAME, self._contract.to_record())
        if self._task is not None:
            data = self._task.data
            writer.attach(ATTACHMENT, data, media_type=MEDIA_TYPE, log_time_ns=self._opened_ns)

    def is_full(self, now_ns: int) -> bool:
        """Say whether the next message belongs into the next part."""
        if self._split_bytes and self.writer.bytes_written >= self._split_bytes:
            return True
        return bool(self._split_ns) and now_ns - self._opened_ns >= self._split_ns

    def roll(self, now_ns: int) -> None:
        """Go on in a new part.

        Raises:
            OSError: When the disk refuses it.
        """
        full = self.writer
        self._say_part(full, is_last=False)
        self.index += 1
        try:
            self.writer = self._open(now_ns)
        except BridgeError as error:
            self.index -= 1
            if isinstance(error.__cause__, OSError):
                raise error.__cause__ from error
            raise
        self._join()
        self._full.append(full)
        self._finisher = threading.Thread(target=self._finish, name="finish part", daemon=True)
        self._finisher.start()

    def _say_part(self, writer: EpisodeWriter, *, is_last: bool) -> None:
        if self._is_split and writer is not self._said:
            values = {"index": json.dumps(self.index), "last": json.dumps(is_last)}
            writer.add_metadata("split", values)
            self._said = writer

    def _finish(self) -> None:
        try:
            while self._full:
                self._full[0].close()
                del self._full[0]
        except OSError as error:
            self._error = error

    def _join(self) -> None:
        if self._finisher is not None:
            self._finisher.join()
            self._finisher = None
        self.tick()

    def tick(self) -> None:
        """Write what has waited long enough; raises OSError for any part."""
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        self.writer.tick()

    def close(self) -> Path:
        """Finish all parts; may be called again after an OSError."""
        if self._finisher is not None:
            self._finisher.join()
            self._finisher = None
        self._error = None
        while self._full:
            self._full[0].close()
            del self._full[0]
        self._say_part(self.writer, is_last=True)
        self.writer.close()
        return self.first_path

    def abandon(self) -> None:
        """Stop without finishing; ``.part`` files stay for recovery."""
        if self._finisher is not None:
            self._finisher.join()
        for writer in (*self._full, self.writer):
            with contextlib.suppress(OSError):  # the disk that failed may fail again
                writer.abandon()

    def discard(self) -> None:
        """Remove all parts: the take was not wanted."""
        if self._finisher is not None:
            self._finisher.join()
        for writer in (*self._full, self.writer):
            writer.discard()
        for path in self._paths:
            path.unlink(missing_ok=True)
