"""What all episodes of a run say of themselves, each read once and then kept.

A file is its bytes, and the SHA-256 of them is what everything else goes by. A file whose size,
both times and inode are those of the last evaluation is taken to hold the bytes it held then; one
that changed within the last two seconds is hashed again next time.
"""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from bridge.episode.assigned import TRIAL_SUFFIX
from bridge.episode.catalogue_query import LABEL_SUFFIX, stamp_of
from bridge.episode.provenance import hash_file
from bridge.episode.run_folder import RunFolder, file_names
from bridge.errors import GstError
from bridge.process_pool import ALONE, ProcessPool
from bridge.terminal import Output
from evaluator.cache import SummaryCache
from evaluator.result import Exclusion
from evaluator.run_reader import episodes
from evaluator.run_reader.episodes import DerivedFacts, DerivedFile, RecordedFacts, RunFile

ODD = (GstError, OSError, TypeError, ValueError, KeyError, RecursionError)
"""What one file of another program, or a failing disk, may raise; it costs that file only."""

MOST_THREADS = 4
"""Hashing waits for the disk or runs outside Python's lock."""
MEGABYTE = 1_000_000
READ_S = 0.0015
"""About what reading one file takes [s]."""

Facts = TypeVar("Facts", RecordedFacts, DerivedFacts)


@dataclass(frozen=True, kw_only=True)
class RecordedFile:
    """One recorded episode and what it says of itself."""

    file: RunFile
    facts: RecordedFacts


@dataclass(frozen=True, kw_only=True)
class RunContents:
    """Everything an evaluation starts from."""

    recorded: tuple[RecordedFile, ...]
    derived: tuple[DerivedFile, ...]
    left_out: tuple[Exclusion, ...]
    """Files that could not be read, and why."""

    @property
    def sources(self) -> dict[str, RunFile]:
        """Recorded episodes by their id."""
        return {each.facts.info.id: each.file for each in self.recorded}


def read_contents(
    run: RunFolder, cache: SummaryCache, output: Output, pool: ProcessPool = ALONE
) -> RunContents:
    """Read what is new or has changed in a run; a broken file is left out and named."""
    recorded, derived, left_out = _take_inventory(run, cache, output)
    labels = _labels(run)
    by_label = {f"{f.name} {f.sha256} {labels.get(f.stem, '')}": f for f in recorded}
    reading = partial(_tried, partial(episodes.read_recorded, run))
    facts, broken_recorded = _read(by_label, RecordedFacts, reading, cache, pool.map, output)
    by_bytes = {f"{file.name} {file.sha256}": file for file in derived}
    reading_derived = partial(_tried, episodes.read_derived)
    made, broken_derived = _read(by_bytes, DerivedFacts, reading_derived, cache, pool.map, output)
    found, doubled = _each_once(
        [RecordedFile(file=file, facts=facts[file.name]) for file in recorded if file.name in facts]
    )
    return RunContents(
        recorded=tuple(found),
        derived=tuple(
            DerivedFile(**vars(f), facts=made[f.name]) for f in derived if f.name in made
        ),
        left_out=(*left_out, *broken_recorded, *broken_derived, *doubled),
    )


@dataclass(frozen=True, kw_only=True)
class FileHash:
    """What a file's bytes were when it had a certain size, times and inode."""

    sha256: str


def _take_inventory(
    run: RunFolder, cache: SummaryCache, output: Output
) -> tuple[list[RunFile], list[RunFile], list[Exclusion]]:
    """Hash what is new or has changed: recorded files, derived ones, and what cannot be read."""
    now_ns = time.time_ns()
    folders = (run.episodes_dir, run.derived_dir)
    there = [(folder, each) for folder in folders for each in file_names(folder)]
    hashes: dict[str, str | Exception] = {}
    unknown: dict[str, Path] = {}
    keys: dict[str, str] = {}  # what a hash is kept under; none where the stamp cannot be relied on
    for folder, file_name in there:
        name = f"{folder.name}/{file_name}"
        stamp = stamp_of([os.path.join(folder, file_name)], now_ns)  # noqa: PTH118
        key = f"{name} {stamp}" if stamp else ""
        known = cache.find(FileHash, key) if key else None
        hashes[name] = known[0].sha256 if known else ""
        if not known:
            unknown[name], keys[name] = folder / file_name, key
    for name, found in _hashed(unknown, output):
        hashes[name] = found
        if keys[name] and isinstance(found, str):
            cache.keep(FileHash, keys[name], (FileHash(sha256=found),))
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


def _hashed(unknown: Mapping[str, Path], output: Output) -> Iterator[tuple[str, str | Exception]]:
    if not unknown:
        return
    sizes = [*map(_size, unknown.values())]
    done = 0
    with (
        output.progress("hash files (MB)", -(-sum(sizes) // MEGABYTE)) as advance,
        ThreadPoolExecutor(min(MOST_THREADS, os.cpu_count() or 1)) as pool,
    ):
        try:
            all_found = pool.map(_sha256, unknown.values())
            for name, size, found in zip(unknown, sizes, all_found, strict=True):
                done += size
                advance(done // MEGABYTE, name)
                yield name, found
        except BaseException:
            pool.shutdown(cancel_futures=True)  # gigabytes may be waiting
            raise


def _sha256(path: Path) -> str | Exception:
    try:
        return hash_file(path)
    except OSError as error:
        return error


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _each_once(files: Sequence[RecordedFile]) -> tuple[list[RecordedFile], list[Exclusion]]:
    """Keep one file of each episode; what a backup or a sync left beside it counts no trial twice.

    One that can be judged goes before a broken one, one named as its episode before a copy.
    """
    best: dict[str, RecordedFile] = {}
    for each in files:
        name = each.facts.info.id
        if name not in best or _rank(each) < _rank(best[name]):
            best[name] = each
    kept = [each for each in files if best[each.facts.info.id] is each]
    doubled = [
        Exclusion(
            episode=each.file.path.name,
            scope="everything",
            reason=f"it is episode {each.facts.info.id} once more, which "
            f"{best[each.facts.info.id].file.path.name} is; an episode counts once",
        )
        for each in files
        if best[each.facts.info.id] is not each
    ]
    return kept, doubled


def _rank(each: RecordedFile) -> tuple[bool, bool]:
    return bool(each.facts.broken), each.file.stem != each.facts.info.id


def _labels(run: RunFolder) -> dict[str, str]:
    """Return the content hash of what was said afterwards, by the stem of its episode."""
    found: dict[str, str] = {}
    for suffix in (LABEL_SUFFIX, TRIAL_SUFFIX):
        for path in run.notes_dir.glob(f"*{suffix}"):
            name = path.name.removesuffix(suffix)
            try:
                found[name] = f"{found.get(name, '')} {hash_file(path)}"
            except OSError:  # whoever reads it will say so
                continue
    return found


def _tried(read: Callable[[Path], Facts], file: RunFile) -> Facts | Exclusion:
    try:
        return read(file.path)
    except ODD as error:
        return broken(file.path.name, error)


def _read(
    files: Mapping[str, RunFile],
    kind: type[Facts],
    read: Callable[[RunFile], Facts | Exclusion],
    cache: SummaryCache,
    spread: Callable[..., Iterator[Facts | Exclusion]],
    output: Output,
) -> tuple[dict[str, Facts], list[Exclusion]]:
    """Return what files, by what their facts are kept under, say, by name; and the unreadable."""
    kept = {file.name: cache.find(kind, key) for key, file in files.items()}
    facts = {name: found[0] for name, found in kept.items() if found}
    unknown = {key: file for key, file in files.items() if file.name not in facts}
    left_out: list[Exclusion] = []
    if not unknown:
        return facts, left_out
    with output.progress("read episodes", len(unknown)) as advance:
        all_made = spread(read, list(unknown.values()), each_s=READ_S)
        for done, ((key, file), made) in enumerate(
            zip(unknown.items(), all_made, strict=True), start=1
        ):
            if isinstance(made, Exclusion):
                left_out.append(made)
            else:
                facts[file.name] = made
                if not made.broken:  # a message names the folder, which may move
                    cache.keep(kind, key, (made,))
            advance(done, file.path.name)
    return facts, left_out


def broken(name: str, error: Exception, *, scope: str = "everything") -> Exclusion:
    """Leave a file out of something, with what reading it raised."""
    words = str(error) if isinstance(error, GstError) else f"{type(error).__name__}: {error}"
    return Exclusion(episode=name, scope=scope, reason=words)
