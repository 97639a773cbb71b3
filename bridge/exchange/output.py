"""Where exports go: a folder that appears whole or not at all, and names that stay inside it."""

import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from bridge.episode.provenance import hash_file, software
from bridge.episode.reader import Episode
from bridge.errors import BridgeError, EpisodeError, UsageError
from bridge.terminal import Output


@contextmanager
def message_named(episode: Episode, topic: str, number: int) -> Iterator[None]:
    """Name the message in whatever goes wrong in the block; ``number`` counts from 1."""
    try:
        yield
    except BridgeError as error:
        raise EpisodeError(
            path=episode.path,
            found=f"message {number} of {topic}: {error}",
            hint="robot-gst check lists everything that is wrong with it.",
        ) from error


class Unused(NamedTuple):
    """Something that came in and that no command will use."""

    what: str
    why: str
    is_needed: bool = False
    """Whether a later command asks for what it would have been."""


def tell_unused(output: Output, unused: Iterable[Unused]) -> int:
    """Say what was not used; return 3 where a later command needs some of it, else 0."""
    code = 0
    for item in unused:
        output.say(f"  not used: {item.what}: {item.why}")
        code = 3 if item.is_needed else code
    return code


NOTE_NAME = "robot_gst_export.json"
"""Says what an exported folder is made of; also the proof that ``--force`` may replace it."""
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")


@contextmanager
def new_folder(out: Path, *, force: bool) -> Iterator[Path]:
    """Yield a folder to fill; it becomes ``out`` when the block ends well, and is removed if not.

    Raises:
        UsageError: When something is there that may not be replaced.
    """
    if out.is_symlink() or out.exists():
        _refuse_strangers(out, force=force)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".part", dir=out.parent))
    except OSError as error:
        message = f"cannot write into {out.parent}: {error.strerror}. Choose another place."
        raise BridgeError(message) from error
    try:
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o777 & ~mask)
        yield part
        _sync(part)
        if out.is_dir():
            shutil.rmtree(out)
        part.rename(out)
    except BaseException as error:
        shutil.rmtree(part, ignore_errors=True)
        if isinstance(error, OSError):  # a full disk does not say where
            error.filename = error.filename or str(out)
        raise


def _refuse_strangers(out: Path, *, force: bool) -> None:
    if not out.is_symlink() and out.is_dir():
        if not any(out.iterdir()):
            return
        if (out / NOTE_NAME).is_file():
            if force:
                return
            message = f"{out} exists already. Choose another folder, or replace it with --force."
            raise UsageError(message)
    raise UsageError(
        f"{out} exists and was not written by an export, so it is not replaced. "
        "Choose another folder, or move it away."
    )


def _sync(folder: Path) -> None:
    for path in (each for each in sorted(folder.rglob("*")) if each.is_file()):
        with path.open("rb") as stream:
            os.fsync(stream.fileno())


def write_note(folder: Path, *, made_by: str, sources: list[Path], choices: dict[str, Any]) -> None:
    """Write what the folder is made of: sources with their hashes, software, every choice."""
    record = {
        "made_by": made_by,
        "software": software(),
        "sources": [{"file": path.name, "sha256": hash_file(path)} for path in sources],
        "stand_in": any(Episode.open(path).info.stand_in for path in sources),
        **choices,
    }
    text = json.dumps(record, indent=1, ensure_ascii=False) + "\n"
    (folder / NOTE_NAME).write_text(text, encoding="utf-8")


def is_of_stand_in(folder: Path) -> bool:
    """Whether the note of an export says that a simulated laboratory recorded it."""
    try:
        record = json.loads((folder / NOTE_NAME).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(record, dict) and record.get("stand_in") is True


def safe_names(names: Iterable[str]) -> dict[str, str]:
    """Give each name from a recording one that can be a file's, and no two the same."""
    safe: dict[str, str] = {}
    for name in names:
        stem = _UNSAFE.sub("_", name).strip("_") or "unnamed"
        number, candidate = 1, stem
        while candidate in safe.values():
            number += 1
            candidate = f"{stem}_{number}"
        safe[name] = candidate
    return safe
