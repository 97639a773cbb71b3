"""What was read from files that have not changed since, kept in Parquet beside the results.

A summary is a frozen dataclass that follows from the bytes of a few files and from nothing else.
It is kept under a key that names those bytes by their content hash, together with a digest of the
code that makes summaries, so that neither a changed file nor changed code is answered from here.
Files of summaries are each written whole under a name of its own, so any number of evaluations may
write at once, one may be killed at any instant, and the folder may be deleted at any time. Nothing
that is wrong with it raises; whoever asks is told once.
``docs/decisions/0008-caches-and-processes.md`` says why.
"""

import hashlib
import re
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import bridge
import evaluator
from bridge.episode.provenance import software

if TYPE_CHECKING:
    from types import ModuleType


Say = Callable[[str], None]

TRIES = 3
"""Another evaluation may fold files into a new one while they are read: they are looked for again.
"""
ABANDONED_S = 3600.0
"""A half-written file this old has lost its writer."""
SUMMING_UP = {
    evaluator: ("cache_file.py", "compare", "metrics", "run_reader"),
    bridge: ("clock.py", "episode", "geometry", "media", "task"),
}
"""The code that reads episodes and sums them up."""


@dataclass
class Found:
    """What a folder holds of one kind of summary."""

    rows: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    """Where they were read from."""
    useless: list[Path] = field(default_factory=list)
    """Damaged, foreign, or of other code."""


class CacheFolder:
    """Files of summaries, by kind."""

    def __init__(self, path: Path, say: Say) -> None:
        """Use a folder, which need not exist; ``say`` hears what makes the evaluation slower."""
        self._path = path
        self._say = say
        self._can_write = True
        self._has_complained = False
        self._parquet = self._import_parquet()

    @property
    def is_of_use(self) -> bool:
        """Whether anything can be kept here."""
        return self._parquet is not None and self._can_write

    def files_of(self, kind: type[Any]) -> list[Path]:
        """List the files of a kind of summary."""
        name = re.compile(rf"{kind.__name__}\.[0-9a-f]{{16}}\.parquet")
        try:
            return sorted(path for path in self._path.iterdir() if name.fullmatch(path.name))
        except OSError:  # not there, or not ours to read
            return []

    def read(self, kind: type[Any]) -> Found:
        """Read all summaries of a kind."""
        found, reasons = Found(), list[str]()
        for _ in range(TRIES):
            found, reasons, is_whole = self._try_to_read(kind)
            if is_whole:
                break
        if reasons and not self._has_complained:  # the other kinds are alike
            self._has_complained = True
            more = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
            self._say(f"In {self._path}, {reasons[0]}{more}. The episodes are read again.")
        return found

    def _try_to_read(self, kind: type[Any]) -> tuple[Found, list[str], bool]:
        found, reasons, is_whole = Found(), list[str](), True
        if self._parquet is None:
            return found, reasons, is_whole
        for path in self.files_of(kind):
            try:
                found.rows |= self._parquet.read_summaries(path, kind, code_version())
                found.files.append(path)
            except FileNotFoundError:
                is_whole = False
            except self._parquet.UnusableFileError as error:
                found.useless.append(path)
                reasons.append(f"{path.name}: {error}")
        return found, reasons, is_whole

    def write(self, kind: type[Any], rows: Mapping[str, tuple[Any, ...]]) -> Path | None:
        """Write summaries into a new file; None where the disk refuses.

        Args:
            kind: The dataclass of the summaries; its name begins the file's name.
            rows: Summaries by the key they are kept under.
        """
        if self._parquet is None or not self._can_write:
            return None
        path = self._path / f"{kind.__name__}.{secrets.token_hex(8)}.parquet"
        try:
            self._parquet.write_summaries(path, kind, rows, code_version())
        except OSError as error:
            self._can_write = False
            self._say(
                f"{self._path} cannot be written ({error.strerror}): the next evaluation reads "
                "these files again."
            )
            return None
        return path

    def remove(self, path: Path) -> None:
        """Delete a file, if it is still there and ours."""
        try:
            path.unlink(missing_ok=True)
        except OSError:  # it is only read once more
            return

    def sweep(self) -> None:
        """Delete what killed evaluations left half-written."""
        for path in self._path.glob("*.parquet*.part"):
            try:
                if time.time() - path.stat().st_mtime > ABANDONED_S:
                    path.unlink()
            except OSError:  # its writer has just finished it
                continue

    def _import_parquet(self) -> "ModuleType | None":
        try:
            from evaluator import cache_file  # noqa: PLC0415  # pyarrow may be missing
        except ModuleNotFoundError as error:
            if error.name != "pyarrow":
                raise
            self._say(
                "pyarrow is not installed (pip install 'robot-gst[report]'): nothing is kept for "
                "the next evaluation, which reads all files again."
            )
            return None
        return cache_file


@cache
def code_version() -> str:
    """Return a digest of the code that sums episodes up, as it is on the disk."""
    digest = hashlib.sha256(software()["version"].encode())
    for package, places in SUMMING_UP.items():
        root = Path(str(package.__file__)).parent
        for place in places:
            path = root / place
            files = [path] if path.is_file() else sorted(path.rglob("*"))
            for file in files:
                if file.suffix in (".py", ".json"):
                    digest.update(f"{file.relative_to(root)}\0".encode())
                    digest.update(file.read_bytes())
    return digest.hexdigest()


Summary = TypeVar("Summary")

FOLDER = "cache"
"""Beside ``results.json``."""
SAVE_PERIOD_S = 20.0
"""An evaluation that is killed loses no more work than this."""
MOST_FILES = 4
"""A kind of summary in more files than this is folded into one."""
MOST_UNUSED = 0.2
"""So is one of which a larger share is about files that are gone or have changed."""


@dataclass
class _Kept:
    """All summaries of one kind."""

    found: Found
    new: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    """Those no file holds yet; also among the rows found."""
    used: set[str] = field(default_factory=set)

    @property
    def is_untidy(self) -> bool:
        rows, files = self.found.rows, self.found.files
        unused = len(rows) - len(self.used)
        return (
            bool(self.found.useless)
            or len(files) + bool(self.new) > MOST_FILES
            or unused > MOST_UNUSED * len(rows)
        )


class SummaryCache:
    """Summaries by kind and key. Use as a context manager, which keeps what was made.

    Nothing that is wrong with the folder ends an evaluation: it only takes longer.
    """

    def __init__(
        self,
        folder: Path | None,
        *,
        fresh: bool = False,
        say: Say = lambda text: None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """Use a folder, which need not exist.

        Args:
            folder: None keeps nothing.
            fresh: Believe nothing that was kept, and keep what is made now.
            say: Called about whatever makes the evaluation take longer.
            monotonic: The clock of periodic saving [s].
        """
        self._folder = None if folder is None else CacheFolder(folder, say)
        self._fresh = fresh
        self._monotonic = monotonic
        self._saved_s = monotonic()
        self._kept: dict[type[Any], _Kept] = {}

    def kept_or_made(
        self, kind: type[Summary], key: str, make: Callable[[], tuple[Summary, ...]]
    ) -> tuple[Summary, ...]:
        """Return what is kept under a key, or make and keep it; what ``make`` raises passes.

        Args:
            kind: The dataclass of the summaries.
            key: Names what they are made from, so that a changed file has another key.
            make: Makes them where nothing is kept.
        """
        found = self.find(kind, key)
        if found is None:
            found = make()
            self.keep(kind, key, found)
        return found

    def find(self, kind: type[Summary], key: str) -> tuple[Summary, ...] | None:
        """Return what is kept under a key, None where nothing is.

        Args:
            kind: The dataclass of the summaries.
            key: What they were kept under; it counts as used from now on.
        """
        kept = self._of(kind)
        found = kept.found.rows.get(key)
        if found is not None:
            kept.used.add(key)
        return found

    def keep(self, kind: type[Summary], key: str, made: tuple[Summary, ...]) -> None:
        """Keep summaries under a key; now and then everything new is written.

        Args:
            kind: The dataclass of the summaries.
            key: Names what they were made from, so that a changed file has another key.
            made: The summaries; none is an answer too.
        """
        if self._folder is None or not self._folder.is_of_use:
            return
        kept = self._of(kind)
        kept.found.rows[key] = kept.new[key] = made
        kept.used.add(key)
        if self._monotonic() - self._saved_s > SAVE_PERIOD_S:
            self.save()

    def save(self) -> None:
        """Write what no file holds yet."""
        for kind, kept in self._kept.items():
            if kept.new:
                self._write(kind, kept, kept.new)
        self._saved_s = self._monotonic()

    def close(self) -> None:
        """Write what is new, and drop what this evaluation had no use for."""
        for kind, kept in self._kept.items():
            if kept.is_untidy:
                self._fold(kind, kept)
        self.save()
        if self._folder is not None:
            self._folder.sweep()

    def _fold(self, kind: type[Any], kept: _Kept) -> None:
        before = [*kept.found.files, *kept.found.useless]
        used = {key: kept.found.rows[key] for key in kept.used}
        if self._folder is None or (used and not self._write(kind, kept, used)):
            return
        for path in before:  # only now: what replaces them is on the disk
            self._folder.remove(path)

    def _write(self, kind: type[Any], kept: _Kept, rows: dict[str, tuple[Any, ...]]) -> bool:
        path = None if self._folder is None else self._folder.write(kind, rows)
        if path is None:
            return False
        kept.found.files.append(path)
        kept.new = {}
        return True

    def _of(self, kind: type[Any]) -> _Kept:
        if kind not in self._kept:
            if self._folder is None:
                found = Found()
            elif self._fresh:
                found = Found(useless=self._folder.files_of(kind))
            else:
                found = self._folder.read(kind)
            self._kept[kind] = _Kept(found)
        return self._kept[kind]

    def __enter__(self) -> "SummaryCache":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Keep what was made; what an interrupted evaluation did not use is not dropped."""
        if kind is None:
            self.close()
        else:
            self.save()
