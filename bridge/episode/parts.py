"""Find the files of a split episode: ``<id>.mcap``, ``<id>.2.mcap``, ``<id>.3.mcap`` ..."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from bridge.episode import metadata
from bridge.episode.mcap.file import McapFile
from bridge.episode.mcap.walk import DAMAGE
from bridge.episode.run import EPISODE_ID, part_name

_NAME = re.compile(rf"({EPISODE_ID.pattern})(?:\.([1-9][0-9]{{0,5}}))?\.mcap")


class PartName(NamedTuple):
    """What a file name says."""

    episode_id: str
    number: int
    """1 for the first part, and for an episode in one file."""


def name_of_part(path: Path) -> PartName | None:
    """Read a file name; None for names no recorder of ours gives."""
    found = _NAME.fullmatch(path.name)
    return None if found is None else PartName(found[1], int(found[2] or 1))


@dataclass(frozen=True, kw_only=True)
class Parts:
    """The files of one episode that can be read, in order."""

    files: tuple[McapFile, ...]
    missing: tuple[Path, ...]
    """Parts that are not there or cannot be read, by the name they should have."""


def open_parts(path: Path) -> Parts:
    """Open a file and, where it is part of a split episode, the parts behind it.

    A part says in its ``split`` record whether it is the last. Recovered parts may not say it:
    then the highest number that is there counts as the last.

    Raises:
        BrokenRecordError: When the first file is no finished MCAP file.
        OSError: When the first file cannot be read.
    """
    first = McapFile(path)
    name = name_of_part(path)
    if name is None or is_last_part(first):
        return Parts(files=(first,), missing=())
    following = path.with_name(part_name(name.episode_id, name.number + 1))
    if split_of(first) is None and not _was_cut_off(first) and not following.exists():
        return Parts(files=(first,), missing=())
    return _follow(first, *name)


def _follow(first: McapFile, episode_id: str, index: int) -> Parts:
    files, missing = [first], []
    highest: int | None = None
    while not is_last_part(files[-1]):
        index += 1
        path = first.path.with_name(part_name(episode_id, index))
        file = _open_later(path, of=first)
        if file is not None:
            files.append(file)
            continue
        if highest is None:  # a hole: is there anything behind it?
            highest = _highest_part(first.path, episode_id)
        if index > highest:
            if not _was_cut_off(files[-1]) or path.exists():
                missing.append(path)
            break
        missing.append(path)
    return Parts(files=tuple(files), missing=tuple(missing))


def _open_later(path: Path, *, of: McapFile) -> McapFile | None:
    if not path.is_file():
        return None
    try:
        file = McapFile(path)
    except DAMAGE:
        return None
    ids = {record.get("id") for record in (record_of(of, "episode"), record_of(file, "episode"))}
    return file if len(ids - {None}) < 2 else None


def _highest_part(path: Path, episode_id: str) -> int:
    names = map(name_of_part, path.parent.glob(f"{episode_id}.*.mcap"))
    return max((name.number for name in names if name is not None), default=1)


def record_of(file: McapFile, name: str) -> dict[str, Any]:
    """Return a metadata record of one file with its values parsed, empty where there is none."""
    values: dict[str, Any] = {}
    for record in file.metadata:
        if record.name == name:
            values = metadata.from_strings(record.metadata)
    return values


def split_of(file: McapFile) -> dict[str, Any] | None:
    """Return the ``split`` record, or None."""
    return record_of(file, "split") or None


def is_last_part(file: McapFile) -> bool:
    """Whether a file says that no part follows."""
    split = split_of(file)
    return split is not None and split.get("last") is True


def _was_cut_off(file: McapFile) -> bool:
    """Whether the end of this part is unknown because its writer died: no part need follow."""
    return any(record.name == "recovered" for record in file.metadata)
