"""The episodes of a run folder with the content hash of each; only what has changed is hashed.

A file is its bytes, and the SHA-256 of them is what everything else goes by. A file whose size,
both times and inode are those of the last evaluation is taken to hold the bytes it held then; one
that changed within the last two seconds is hashed again next time.
"""

import os
import time
from collections.abc import Iterable, Iterator
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
class Inventory:
    """Everything a run folder holds."""

    recorded: tuple[RunFile, ...]
    derived: tuple[RunFile, ...]
    left_out: tuple[Exclusion, ...]
    """Files that cannot be read at all."""


@dataclass(frozen=True, kw_only=True)
class _Seen:
    folder: Path
    names: list[str]
    """Of all parts."""
    name: str
    is_derived: bool
    stamp: str
    """Empty where it cannot be relied on."""

    @property
    def path(self) -> Path:
        return self.folder / self.names[0]

    @property
    def parts(self) -> list[Path]:
        return [self.folder / name for name in self.names]


def take_inventory(run: RunFolder, cache: SummaryCache, output: Output) -> Inventory:
    """Look at every file of a run, and hash those that are new or have changed."""
    seen = list(_look(run))
    hashes, left_out = _hash(seen, cache, output)
    files: dict[bool, list[RunFile]] = {False: [], True: []}
    for each in seen:
        if each.name in hashes:
            file = RunFile(folder=run.path, name=each.name, sha256=hashes[each.name])
            files[each.is_derived].append(file)
    return Inventory(
        recorded=tuple(files[False]), derived=tuple(files[True]), left_out=tuple(left_out)
    )


def _look(run: RunFolder) -> Iterator[_Seen]:
    now_ns = time.time_ns()
    recorded, derived = run.episodes_dir, run.derived_dir
    groups = [(recorded, parts) for parts in run.episode_parts().values()]
    groups += [(derived, [path.name]) for path in run.derived()]
    for folder, names in groups:
        yield _Seen(
            folder=folder,
            names=names,
            name=f"{folder.name}/{names[0]}",
            is_derived=folder is derived,
            stamp=stamp_of([os.path.join(folder, name) for name in names], now_ns),  # noqa: PTH118
        )


def _hash(
    seen: Iterable[_Seen], cache: SummaryCache, output: Output
) -> tuple[dict[str, str], list[Exclusion]]:
    """Return the hashes by name, and what cannot be read."""
    hashes, unknown = {}, []
    for each in seen:
        known = cache.find(FileHash, _key(each)) if each.stamp else None
        if known:
            hashes[each.name] = known[0].sha256
        else:
            unknown.append(each)
    left_out = []
    for each, found in _hashed(unknown, output):
        if isinstance(found, str):
            hashes[each.name] = found
            if each.stamp:
                cache.keep(FileHash, _key(each), (FileHash(sha256=found),))
        else:
            left_out.append(
                Exclusion(episode=each.path.name, scope="everything", reason=str(found))
            )
    return hashes, left_out


def _key(seen: _Seen) -> str:
    return f"{seen.name} {seen.stamp}"


def _hashed(unknown: list[_Seen], output: Output) -> Iterator[tuple[_Seen, str | Exception]]:
    if not unknown:
        return
    sizes = [sum(_size(part) for part in each.parts) for each in unknown]
    workers = min(MOST_THREADS, os.cpu_count() or 1)
    done = 0
    with (
        output.progress("hash files (MB)", -(-sum(sizes) // MEGABYTE)) as advance,
        ThreadPoolExecutor(workers) as pool,
    ):
        try:
            for each, size, found in zip(unknown, sizes, pool.map(_sha256, unknown), strict=True):
                done += size
                advance(done // MEGABYTE, each.path.name)
                yield each, found
        except BaseException:
            pool.shutdown(cancel_futures=True)  # gigabytes may be waiting
            raise


def _sha256(seen: _Seen) -> str | Exception:
    try:
        parts = seen.parts if len(seen.parts) == 1 else Episode.open(seen.path).parts
        return hash_files(parts)
    except (GstError, OSError) as error:
        return error


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
