"""A copy of a run elsewhere: resumable, each file verified by its hash before it gets its name.

The copy is of finished files only: no ``.part``, no journal, no cache. ``sync.json`` beside them
says what was verified. Nothing is ever removed there; a file that changed here replaces its copy.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

from bridge.episode.catalogue_store import FILE_NAME
from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError, GstError, UsageError
from bridge.whole_file import write_whole

MANIFEST = "sync.json"
PARTIAL = ".partial"
"""Ends the name of a file that is not verified yet."""
BLOCK = 4_000_000
LEFT_OUT = (".part", ".journal", PARTIAL, "-wal", "-shm")

Advance = Callable[[int, str], None]
"""Called as ``advance(bytes done, file)``."""


class SyncError(BridgeError):
    """A copy is not what it should be, or the other side refused it."""


@dataclass(frozen=True, kw_only=True)
class SyncReport:
    """What one run of the command did."""

    destination: str
    copied: tuple[str, ...]
    resumed: tuple[str, ...]
    """Those of which a part was there."""
    unchanged: int
    num_bytes: int
    """Sent now."""
    failed: dict[str, str]
    """By file, what went wrong; run the command again."""


@runtime_checkable
class Target(Protocol):
    """Where the copy goes."""

    def read(self, name: str) -> bytes | None:
        """A small file; None where there is none."""

    def write(self, name: str, data: bytes) -> None:
        """Replace a small file."""

    def size(self, name: str) -> int | None:
        """How large a file is; None where there is none."""

    def blocks(self, name: str) -> Iterator[bytes]:
        """The content of a file."""

    def append(self, name: str, blocks: Iterator[bytes], *, is_new: bool) -> None:
        """Write behind what is there, or anew."""

    def rename(self, old: str, new: str) -> None:
        """Give a file its final name, replacing one that has it."""

    @property
    def can_resume(self) -> bool:
        """Whether ``append`` can write behind what is there."""


class FolderTarget:
    """A folder of this machine, or one that is mounted."""

    can_resume = True

    def __init__(self, root: Path) -> None:
        """Make the folder where needed."""
        self._root = root
        root.mkdir(parents=True, exist_ok=True)

    def read(self, name: str) -> bytes | None:
        """A small file; None where there is none."""
        path = self._root / name
        return path.read_bytes() if path.is_file() else None

    def write(self, name: str, data: bytes) -> None:
        """Replace a small file."""
        write_whole(self._root / name, data)

    def size(self, name: str) -> int | None:
        """How large a file is; None where there is none."""
        path = self._root / name
        return path.stat().st_size if path.is_file() else None

    def blocks(self, name: str) -> Iterator[bytes]:
        """The content of a file."""
        with (self._root / name).open("rb") as stream:
            while block := stream.read(BLOCK):
                yield block

    def append(self, name: str, blocks: Iterator[bytes], *, is_new: bool) -> None:
        """Write behind what is there, or anew; what is written is on the disk afterwards."""
        path = self._root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb" if is_new else "ab") as stream:
            for block in blocks:
                stream.write(block)
            stream.flush()
            os.fsync(stream.fileno())

    def rename(self, old: str, new: str) -> None:
        """Give a file its final name, replacing one that has it."""
        (self._root / old).replace(self._root / new)


class RemoteTarget:
    """Whatever fsspec can write to: ``s3://``, ``sftp://``, ``memory://`` ..."""

    can_resume = False

    def __init__(self, url: str) -> None:
        """Connect.

        Raises:
            SyncError: Without fsspec, or the package that its protocol needs.
            UsageError: When fsspec knows no such protocol.
        """
        scheme = url.partition(":")[0]
        try:
            from fsspec.core import url_to_fs  # noqa: PLC0415  # only for such targets

            self._fs, self._root = url_to_fs(url)
        except ImportError as error:
            raise SyncError(
                f"{scheme}:// needs fsspec and the package of that protocol, and one of them is "
                f"not installed ({error}). For example: pip install fsspec s3fs."
            ) from error
        except ValueError as error:
            raise UsageError(f"{url}: {error}. fsspec knows no such protocol.") from error

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def read(self, name: str) -> bytes | None:
        """A small file; None where there is none."""
        try:
            return cast("bytes", self._fs.cat_file(self._path(name)))
        except FileNotFoundError:
            return None

    def write(self, name: str, data: bytes) -> None:
        """Replace a small file."""
        self.append(name, iter([data]), is_new=True)

    def size(self, name: str) -> int | None:
        """How large a file is; None where there is none."""
        try:
            self._fs.invalidate_cache()
            return int(self._fs.info(self._path(name))["size"])
        except FileNotFoundError:
            return None

    def blocks(self, name: str) -> Iterator[bytes]:
        """The content of a file."""
        with self._fs.open(self._path(name), "rb") as stream:
            while block := stream.read(BLOCK):
                yield block

    def append(self, name: str, blocks: Iterator[bytes], *, is_new: bool) -> None:
        """Write anew: objects elsewhere are whole."""
        path = self._path(name)
        with contextlib.suppress(FileExistsError, NotImplementedError):
            self._fs.makedirs(path.rpartition("/")[0], exist_ok=True)
        with self._fs.open(path, "wb") as stream:
            for block in blocks:
                stream.write(block)

    def rename(self, old: str, new: str) -> None:
        """Give a file its final name, replacing one that has it."""
        if self.size(new) is not None:
            self._fs.rm_file(self._path(new))
        self._fs.mv(self._path(old), self._path(new))


def open_target(destination: str, run: RunFolder) -> tuple[Target, str]:
    """Open the folder of a run at its destination, and say where that is.

    Args:
        destination: A folder, or a URL of fsspec, that runs are copied into.
        run: Its name is that of the copy.

    Raises:
        UsageError: When the copy would lie in the run itself, or nothing can be written there.
    """
    name = run.path.resolve().name
    if "://" in destination:
        url = f"{destination.rstrip('/')}/{name}"
        return RemoteTarget(url), url
    root = Path(destination) / name
    if root.resolve().is_relative_to(run.path.resolve()):
        raise UsageError(f"{root} lies in the run itself. Choose another folder.")
    try:
        return FolderTarget(root), str(root)
    except OSError as error:
        raise UsageError(f"cannot write {root}: {error.strerror}.") from error


def files_of(run: RunFolder) -> list[str]:
    """What is copied: names from the run's folder, in order."""
    found = []
    for path in run.path.rglob("*"):
        name = path.relative_to(run.path).as_posix()
        is_hidden = any(part.startswith(".") for part in name.split("/"))
        if is_hidden or name.startswith(FILE_NAME) or name.endswith(LEFT_OUT) or name == MANIFEST:
            continue
        if path.is_file() and not path.is_symlink():
            found.append(name)
    return sorted(found)


def sync_run(
    run: RunFolder, destination: str, *, verify: bool = False, advance: Advance
) -> SyncReport:
    """Copy what is not there yet; may be interrupted and called again at any time.

    Args:
        run: What is copied.
        destination: A folder, or a URL of fsspec; the copy is a folder of the run's name in it.
        verify: Read every copy again, also those that were verified before.
        advance: Told how far it is.

    Raises:
        UsageError: When nothing can be written there.
        SyncError: When the list of what was verified cannot be written.
    """
    target, where = open_target(destination, run)
    known = _manifest(target)
    copied, resumed, failed = [], [], {}
    unchanged = done = sent = 0
    for name in files_of(run):
        path = run.path / name
        try:
            before = path.stat()
            entry = {"size": before.st_size, "mtime_ns": before.st_mtime_ns}
            old = known.get(name, {})
            if _is_there(target, name, entry, old, verify=verify):
                unchanged += 1
            else:
                digest, num_bytes, was_there = _copy(target, path, name)
                if path.stat().st_mtime_ns != before.st_mtime_ns:
                    failed[name] = "it changed while it was copied"
                    continue
                known[name] = {**entry, "sha256": digest}
                _write_manifest(target, known)
                copied.append(name)
                sent += num_bytes
                resumed += [name] if was_there else []
        except (OSError, GstError) as error:
            failed[name] = str(error)
        else:
            done += entry["size"]
        advance(done, name)
    return SyncReport(
        destination=where,
        copied=tuple(copied),
        resumed=tuple(resumed),
        unchanged=unchanged,
        num_bytes=sent,
        failed=failed,
    )


def _manifest(target: Target) -> dict[str, dict[str, Any]]:
    try:
        record = json.loads(target.read(MANIFEST) or b"{}")
        files = record.get("files", {})
    except (ValueError, AttributeError, RecursionError):
        return {}  # damaged: everything is looked at again
    if not isinstance(files, dict):
        return {}
    return {name: entry for name, entry in files.items() if isinstance(entry, dict)}


def _write_manifest(target: Target, files: dict[str, dict[str, Any]]) -> None:
    record = {"schema_version": 1, "files": dict(sorted(files.items()))}
    target.write(MANIFEST, (json.dumps(record, indent=1) + "\n").encode())


def _is_there(
    target: Target, name: str, entry: dict[str, int], old: dict[str, Any], *, verify: bool
) -> bool:
    """Whether a copy that was verified is still that of the file."""
    if any(old.get(key) != value for key, value in entry.items()):
        return False
    if target.size(name) != entry["size"]:
        return False
    return not verify or _hash(target.blocks(name)) == old.get("sha256")


def _copy(target: Target, path: Path, name: str) -> tuple[str, int, bool]:
    """Send a file, read it back, and give it its name.

    Returns:
        SHA-256, bytes sent, and whether a part of it was there.
    """
    partial = name + PARTIAL
    at = _same_beginning(target, path, partial) if target.can_resume else 0
    target.append(partial, _blocks(path, at), is_new=not at)
    wanted = _hash(_blocks(path, 0))
    if _hash(target.blocks(partial)) != wanted:
        raise SyncError(f"{name}: what was written there reads back differently. Run it again.")
    target.rename(partial, name)
    return wanted, path.stat().st_size - at, at > 0


def _same_beginning(target: Target, path: Path, partial: str) -> int:
    """How many bytes of a part are those of the file; 0 where it is another file's."""
    size = target.size(partial)
    if not size or size > path.stat().st_size:
        return 0
    theirs, ours = hashlib.sha256(), hashlib.sha256()
    with path.open("rb") as stream:
        for block in target.blocks(partial):
            theirs.update(block)
            ours.update(stream.read(len(block)))
    return size if theirs.digest() == ours.digest() else 0


def _blocks(path: Path, at: int) -> Iterator[bytes]:
    with path.open("rb") as stream:
        stream.seek(at)
        while block := stream.read(BLOCK):
            yield block


def _hash(blocks: Iterator[bytes]) -> str:
    digest = hashlib.sha256()
    for block in blocks:
        digest.update(block)
    return digest.hexdigest()
