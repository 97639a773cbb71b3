"""The episodes of a run folder with the content hash of each; only what has changed is hashed.

A file is its bytes, and the SHA-256 of them is what everything else goes by. A file whose size,
both times and inode are those of the last evaluation is taken to hold the bytes it held then; one
that changed within the last two seconds is hashed again next time.
"""

import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from bridge.episode.catalogue_query import stamp_of
from bridge.episode.provenance import hash_files
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.terminal import Output
from evaluator.cache import SummaryCache
from evaluator.result import Exclusion

MOST_THREADS = 4
"""Hashing waits for the disk or runs outside Python's lock."""
MEGABYTE = 1_000_000


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """One episode of a run, recorded or derived, as it lies on the disk."""

    folder: Path
    """That ``name`` is relative to: the run's."""
    name: str
    """Of its first part, with forward slashes."""
    sha256: str
    """Of the bytes of all parts, one after the other."""

    @property
    def path(self) -> Path:
        """Its first part; made when asked for, most files of a large run are not opened again."""
        return self.folder / self.name

    @property
    def file_name(self) -> str:
        """The name of the file without folder."""
        return self.name.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """The name of the file without folder and ending."""
        return self.file_name.rpartition(".")[0]


@dataclass(frozen=True, kw_only=True)
class FileHash:
    """What a file's bytes were when it had a certain size, times and inode."""

    sha256: str


@dataclass(frozen=True, kw_only=True)
class _Unknown:
    """A file whose hash is not known."""

    name: str
    parts: tuple[Path, ...]
    key: str
    """What its hash is kept under; empty where its stamp cannot be relied on."""


def take_inventory(
    run: RunFolder, cache: SummaryCache, output: Output
) -> tuple[list[RunFile], list[RunFile], list[Exclusion]]:
    """Look at every file of a run, and hash those that are new or have changed.

    Returns:
        Recorded files, derived ones, and what cannot be read at all.
    """
    now_ns = time.time_ns()
    groups = [(run.episodes_dir, parts) for parts in run.episode_parts().values()]
    groups += [(run.derived_dir, [path.name]) for path in run.derived()]
    hashes: dict[str, str | Exception] = {}
    unknown = []
    for folder, parts in groups:
        name = f"{folder.name}/{parts[0]}"
        stamp = stamp_of([os.path.join(folder, part) for part in parts], now_ns)  # noqa: PTH118
        key = f"{name} {stamp}" if stamp else ""
        known = cache.find(FileHash, key) if key else None
        hashes[name] = known[0].sha256 if known else ""
        if not known:
            unknown.append(_Unknown(name=name, parts=tuple(folder / p for p in parts), key=key))
    for each, found in _hashed(unknown, output):
        hashes[each.name] = found
        if each.key and isinstance(found, str):
            cache.keep(FileHash, each.key, (FileHash(sha256=found),))
    left_out = [
        Exclusion(episode=Path(name).name, scope="everything", reason=str(error))
        for name, error in hashes.items()
        if isinstance(error, Exception)
    ]
    files = [
        RunFile(folder=run.path, name=name, sha256=sha256)
        for name, sha256 in hashes.items()
        if isinstance(sha256, str)
    ]
    recorded = [file for file in files if file.name.startswith(f"{run.episodes_dir.name}/")]
    return recorded, files[len(recorded) :], left_out


def _hashed(unknown: list[_Unknown], output: Output) -> Iterator[tuple[_Unknown, str | Exception]]:
    if not unknown:
        return
    sizes = [sum(map(_size, each.parts)) for each in unknown]
    workers = min(MOST_THREADS, os.cpu_count() or 1)
    done = 0
    with (
        output.progress("hash files (MB)", -(-sum(sizes) // MEGABYTE)) as advance,
        ThreadPoolExecutor(workers) as pool,
    ):
        try:
            for each, size, found in zip(unknown, sizes, pool.map(_sha256, unknown), strict=True):
                done += size
                advance(done // MEGABYTE, each.parts[0].name)
                yield each, found
        except BaseException:
            pool.shutdown(cancel_futures=True)  # gigabytes may be waiting
            raise


def _sha256(unknown: _Unknown) -> str | Exception:
    try:
        parts = unknown.parts
        return hash_files(parts if len(parts) == 1 else Episode.open(parts[0]).parts)
    except (GstError, OSError) as error:
        return error


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
