"""The run folder: one run is one cell."""

import fcntl
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import count
from pathlib import Path
from tempfile import TemporaryFile

from bridge.errors import BridgeError, GstError, PathNotFoundError, UsageError

REFUSED_PLAN, PLAN_REPLAY = ".refused.json", ".replay.mcap"
"""What files in ``plans/`` end in: plans that the twin did not accept, and its replays of plans."""
SUFFIX, PART = ".mcap", ".part"
"""What an episode's file ends in, and what stands behind that while it is being written."""
EPISODE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,120}")


def check_episode_id(episode_id: str) -> str:
    """Return the id if it is safe as a file name; remote requests cannot leave the run folder."""
    if not EPISODE_ID.fullmatch(episode_id):
        raise UsageError(
            f"episode id {episode_id!r:.80} is not usable as a file name. "
            "Use letters, digits, '_' and '-', at most 121 characters."
        )
    return episode_id


def file_names(folder: Path, ending: str = SUFFIX) -> list[str]:
    """Return the sorted names of a folder's files; of one that cannot be listed, none."""
    try:
        found = os.listdir(folder)  # noqa: PTH208  # a fifth of the time, for many files
    except OSError:  # not there, or not ours to read
        return []
    return sorted(name for name in found if name.endswith(ending))


ROOM_MB = 64
"""Free space without which no long work begins; a scene, or some dozens of replays, take less."""


def refuse_full(folder: Path) -> None:
    """Find out before an hour of work that a folder cannot be written; it is made where needed."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder) as probe:
            os.posix_fallocate(probe.fileno(), 0, ROOM_MB << 20)
    except OSError as error:
        found = f"cannot write {ROOM_MB} MB into {folder}: {error.strerror}"
        message = f"{found}. Free some space, or copy the run to another disk; nothing was changed."
        raise BridgeError(message) from error


def lock_folder(folder: Path, taken: GstError, *, shared: bool = False) -> int | None:
    """Keep others out of a folder until the descriptor is closed, or raise ``taken``."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise taken from None
    except OSError:  # some network file systems lock no folders
        os.close(descriptor)
        return None
    return descriptor


@dataclass(frozen=True)
class RunFolder:
    """``episodes/``, ``tasks/``, ``scene/``, ``plans/``, ``derived/``, ``results/``, ``notes/``."""

    path: Path

    @staticmethod
    def open(path: Path) -> "RunFolder":
        """Open an existing run folder."""
        if path.is_file():
            message = f"{path} is a file, not a run. Give the folder that its episodes/ lies in."
            raise UsageError(message)
        if not path.is_dir():
            raise PathNotFoundError(
                path=path, what="run folder", hint="Record into it first: robot-gst record RUN."
            )
        return RunFolder(path)

    @staticmethod
    def create(path: Path) -> "RunFolder":
        """Open a run folder, making it where needed."""
        run = RunFolder(path)
        try:
            run.episodes_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            message = f"cannot write the run folder {path}: {error.strerror}. Choose another place."
            raise UsageError(message) from error
        return run

    @cached_property
    def episodes_dir(self) -> Path:
        """Recorded episodes."""
        return self.path / "episodes"

    @property
    def scene_dir(self) -> Path:
        """The rebuilt scene."""
        return self.path / "scene"

    @cached_property
    def derived_dir(self) -> Path:
        """Replays, localisations and views made by the twin."""
        return self.path / "derived"

    @property
    def plans_dir(self) -> Path:
        """Plans made from words, each with the twin's replay of it beside it."""
        return self.path / "plans"

    @property
    def results_dir(self) -> Path:
        """What the evaluator computed."""
        return self.path / "results"

    @property
    def tasks_dir(self) -> Path:
        """Task files of the recorded episodes."""
        return self.path / "tasks"

    @property
    def notes_dir(self) -> Path:
        """Labels and remarks given after the fact."""
        return self.path / "notes"

    def episodes(self) -> list[Path]:
        """Recorded episodes, in name order."""
        return [*map(self.episodes_dir.joinpath, file_names(self.episodes_dir))]

    def free_id(self, kind: str) -> str:
        """The first number after a kind's name of which nothing is left, labels neither."""
        folders = (self.episodes_dir, self.derived_dir, self.notes_dir)
        taken = {name.split(".")[0] for folder in folders for name in file_names(folder, "")}
        ids = (f"{kind}_{number:04d}" for number in count(1))
        return next(each for each in ids if each not in taken)

    def unfinished(self) -> list[Path]:
        """Files in ``episodes/`` and ``derived/`` that are being written, or were left behind."""
        folders = (self.episodes_dir, self.derived_dir)
        return [folder / name for folder in folders for name in file_names(folder, SUFFIX + PART)]

    def refuse_empty(self) -> None:
        """Raise where there is nothing to work on."""
        if not file_names(self.episodes_dir):
            message = f"no episodes in {self.path}. Record some: robot-gst record {self.path}."
            raise UsageError(message)

    @contextmanager
    def alone_in(self, folder: Path) -> Iterator[None]:
        """Let no second command write into one of its folders while the block lasts."""
        self.refuse_empty()
        folder.mkdir(parents=True, exist_ok=True)
        message = f"another command writes into {folder}. Wait for its end, or stop it."
        lock = lock_folder(folder, UsageError(message))
        try:
            yield
        finally:
            if lock is not None:
                os.close(lock)

    def derived(self, pattern: str = "*") -> list[Path]:
        """Derived episode files, in name order."""
        names = (n for n in file_names(self.derived_dir) if fnmatchcase(n, pattern + SUFFIX))
        return [*map(self.derived_dir.joinpath, names)]
