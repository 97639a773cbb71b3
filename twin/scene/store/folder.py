"""The scene folder: ``scene.json`` and ``background.ply``, whole or not at all."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder
from bridge.errors import PathNotFoundError
from bridge.whole_file import beside, write_whole
from twin.errors import UnreadableFileError
from twin.scene.gaussians import GaussianCloud, read_ply

SCENE_VERSION = 1
BACKGROUND = "background.ply"
SCENE_FILE = "scene.json"
NEEDED = ("key", "scene_hash", "background", "sources", "views")
"""What every reader of ``scene.json`` relies on."""
HASH_DIGITS = 12
"""Hexadecimal digits of the SHA-256 of ``background.ply`` that name a scene."""


class UnreadableSceneError(UnreadableFileError):
    """``scene.json`` is damaged or from a newer version."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A rebuilt scene: the static background and how it came to be."""

    record: Mapping[str, Any]
    """The content of ``scene.json``."""
    background: GaussianCloud

    @property
    def scene_hash(self) -> str:
        """Twelve hexadecimal digits of the SHA-256 of ``background.ply``."""
        return str(self.record["scene_hash"])


def read_record(run: RunFolder) -> dict[str, Any] | None:
    """Return ``scene.json``, or None when there is no scene yet."""
    path = run.scene_dir / SCENE_FILE
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text())
    except ValueError as error:
        raise UnreadableSceneError(path=path, found=f"not JSON ({error})") from error
    if not isinstance(record, dict) or record.get("schema_version") != SCENE_VERSION:
        version = record.get("schema_version") if isinstance(record, dict) else None
        found = f"schema version {version!r}, this program knows {SCENE_VERSION}"
        raise UnreadableSceneError(path=path, found=found)
    missing = [name for name in NEEDED if name not in record]
    if missing:
        raise UnreadableSceneError(path=path, found=f"without {', '.join(missing)}")
    return record


def scene_hash_of(run: RunFolder) -> str | None:
    """The hash that verdicts, replays, localisations and views name a run's scene by."""
    record = read_record(run)
    return None if record is None else str(record["scene_hash"])


def background_hash(run: RunFolder) -> str:
    """Name of the scene whose background lies in the folder now."""
    return provenance.hash_file(run.scene_dir / BACKGROUND)[:HASH_DIGITS]


def read_scene(run: RunFolder) -> Scene:
    """Load the rebuilt scene of a run."""
    record = read_record(run)
    if record is None:
        raise PathNotFoundError(
            path=run.scene_dir / SCENE_FILE, what="scene", hint="Make it: robot-gst rebuild RUN."
        )
    scene = Scene(record=record, background=read_ply(run.scene_dir / BACKGROUND))
    if background_hash(run) != scene.scene_hash:
        found = f"describes scene {scene.scene_hash}, {BACKGROUND} is {background_hash(run)}"
        hint = "Make it again: robot-gst rebuild RUN --force."
        raise UnreadableSceneError(path=run.scene_dir / SCENE_FILE, found=found, hint=hint)
    return scene


class _Beside(RunFolder):
    """A run whose scene is the one that is being made."""

    @property
    def scene_dir(self) -> Path:
        return self.path / "scene.part"


@contextmanager
def scene_beside(run: RunFolder) -> Iterator[RunFolder]:
    """A new scene beside the old one, from a copy without its record: a calibration lies there."""
    new = _Beside(run.path)
    with beside(run.scene_dir, new.scene_dir):
        (new.scene_dir / SCENE_FILE).unlink(missing_ok=True)
        yield new


def write_record(run: RunFolder, record: Mapping[str, Any]) -> Path:
    """Write ``scene.json`` last, by renaming: it vouches for everything else in the folder."""
    path = run.scene_dir / SCENE_FILE
    write_whole(path, (json.dumps(record, indent=2) + "\n").encode())
    return path
