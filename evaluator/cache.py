"""What was read from files that have not changed since, kept beside the results.

A summary is a frozen dataclass that follows from the bytes of a few files and from nothing else.
It is kept under a key that names those bytes by their content hash, in a file that names the code
that made it, so that neither a changed file nor changed code is answered from here. There is one
file for each kind of summary, written whole: of two evaluations at once the later one's stays, one
may be killed at any instant, and the folder may be deleted at any time. Nothing that is wrong with
it raises. ``docs/decisions/0008-caches-and-processes.md`` says why.
"""

import contextlib
import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

import bridge
import evaluator
from bridge.episode.provenance import software
from bridge.whole_file import write_whole

Say = Callable[[str], None]
Rows = dict[str, msgspec.Raw]
"""Packed summaries by the key they are kept under; there may be none or several under one."""
Summary = TypeVar("Summary")

FOLDER = "cache"
"""Beside ``results.json``."""
SAVE_PERIOD_S = 20.0
"""An evaluation that is killed loses no more work than this."""
MOST_UNUSED = 0.2
"""A file of which a larger share is about files that are gone or have changed is written anew."""
ABANDONED_S = 3600.0
"""A half-written file this old has lost its writer."""
SUMMING_UP = {
    evaluator: ("cache.py", "compare", "metrics", "run_reader", "statistics"),
    bridge: ("clock.py", "episode", "geometry", "media", "task"),
}
"""The code that reads episodes and sums them up."""
DIGEST_BYTES = 32


@cache
def code_version() -> bytes:
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
    return digest.digest()


packed = msgspec.msgpack.Encoder(enc_hook=np.generic.item).encode
"""As msgpack; numbers of NumPy become plain ones."""
_rows_of = msgspec.msgpack.Decoder(Rows).decode


def _digest(body: bytes | memoryview) -> bytes:
    return hashlib.blake2b(body, key=code_version(), digest_size=DIGEST_BYTES).digest()


def write_rows(path: Path, rows: Rows) -> None:
    """Write summaries, whole or not at all."""
    body = packed(rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, _digest(body) + body)


def read_rows(path: Path) -> Rows:
    """Read the summaries of a file."""
    data = memoryview(path.read_bytes())
    head, body = data[:DIGEST_BYTES], data[DIGEST_BYTES:]
    if head != _digest(body):
        raise ValueError(f"{path.name} is damaged, or another version of this program wrote it")
    return _rows_of(body)


@dataclass
class _Kept:
    """All summaries of one kind."""

    unpack: Callable[[msgspec.Raw], tuple[Any, ...]]
    rows: Rows = field(default_factory=dict)
    used: set[str] = field(default_factory=set)
    is_new: bool = False
    """Whether something is not on the disk yet."""


class SummaryCache:
    """Summaries by kind and key. Use as a context manager, which keeps what was made.

    Nothing that is wrong with the folder ends an evaluation: it only takes longer.
    """

    def __init__(
        self,
        folder: Path | None,
        *,
        say: Say = lambda text: None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """Use a folder, which need not exist; None keeps nothing. ``monotonic``: its clock [s]."""
        self._folder = folder
        self._say_once: Say | None = say
        self._monotonic = monotonic
        self._saved_s = monotonic()
        self._kept: dict[type[Any], _Kept] = {}

    def kept_or_made(
        self, kind: type[Summary], key: str, make: Callable[[], tuple[Summary, ...]]
    ) -> tuple[Summary, ...]:
        """Return what is kept under a key, which names its inputs, or make and keep it.

        A changed file has another key; what ``make`` raises passes.
        """
        found = self.find(kind, key)
        if found is None:
            found = make()
            self.keep(kind, key, found)
        return found

    def find(self, kind: type[Summary], key: str) -> tuple[Summary, ...] | None:
        """Return what is kept under a key, None where nothing is; it counts as used from now on."""
        kept = self._of(kind)
        found = kept.rows.get(key)
        if found is None:
            return None
        kept.used.add(key)
        return kept.unpack(found)

    def keep(self, kind: type[Summary], key: str, made: tuple[Summary, ...]) -> None:
        """Keep summaries under a key, if they can be packed; now and then write what is new."""
        if self._folder is None:
            return
        try:
            raw = msgspec.Raw(packed(made))
            packed(key)
        except (TypeError, ValueError, OverflowError):  # as a name that is no Unicode
            return
        kept = self._of(kind)
        kept.rows[key] = raw
        kept.used.add(key)
        kept.is_new = True
        if self._monotonic() - self._saved_s > SAVE_PERIOD_S:
            self.save()

    def save(self) -> None:
        """Write what no file holds yet."""
        for kind, kept in self._kept.items():
            if kept.is_new and self._folder is not None:
                try:
                    write_rows(self._folder / _name(kind), kept.rows)
                except OSError as error:
                    self._say(
                        f"{self._folder} cannot be written ({error.strerror}): the next evaluation "
                        "reads these files again."
                    )
                    self._folder = None
                kept.is_new = False
        self._saved_s = self._monotonic()

    def close(self) -> None:
        """Write what is new, and drop what this evaluation had no use for."""
        for kept in self._kept.values():
            if len(kept.rows) - len(kept.used) > MOST_UNUSED * len(kept.rows):
                kept.rows = {key: found for key, found in kept.rows.items() if key in kept.used}
                kept.is_new = True
        self.save()
        self._sweep()

    def _of(self, kind: type[Any]) -> _Kept:
        if kind not in self._kept:
            rows: Rows = {}
            if self._folder is not None:
                try:
                    rows = read_rows(self._folder / _name(kind))
                except OSError:  # not there, or not ours to read
                    rows = {}
                except ValueError as error:
                    self._say(f"In {self._folder}, {error}. The episodes are read again.")
            unpack = msgspec.msgpack.Decoder(tuple[kind, ...]).decode  # type: ignore[valid-type]
            self._kept[kind] = _Kept(unpack, rows)
        return self._kept[kind]

    def _say(self, text: str) -> None:
        if self._say_once is not None:
            self._say_once(text)
            self._say_once = None

    def _sweep(self) -> None:
        """Delete what killed evaluations left half-written, and files of editions before."""
        for ending in ("part", "parquet", "sqlite") if self._folder is not None else ():
            for path in (self._folder or Path()).glob(f"*.{ending}"):
                with contextlib.suppress(OSError):  # its writer has just finished it
                    if time.time() - path.stat().st_mtime > ABANDONED_S:
                        path.unlink()

    def __enter__(self) -> "SummaryCache":
        """Use as a context manager."""
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """Keep what was made; what an interrupted evaluation did not use is not dropped."""
        if kind is None:
            self.close()
        else:
            self.save()


def _name(kind: type[Any]) -> str:
    return f"{kind.__name__}.msgpack"
