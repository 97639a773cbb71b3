"""The folder a cache lies in: files of summaries, each written whole under a name of its own.

So any number of evaluations may write at once, one may be killed at any instant, and the folder
may be deleted at any time. Nothing that is wrong with it raises; whoever asks is told once.
"""

import hashlib
import re
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    evaluator: ("compare", "metrics"),
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
        """Write summaries into a new file; None where the disk refuses."""
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
            from evaluator.compare import summary_file  # noqa: PLC0415  # pyarrow may be missing
        except ModuleNotFoundError as error:
            if error.name != "pyarrow":
                raise
            self._say(
                "pyarrow is not installed (pip install 'robot-gst[report]'): nothing is kept for "
                "the next evaluation, which reads all files again."
            )
            return None
        return summary_file


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
