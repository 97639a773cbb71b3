"""The scene folder: ``scene.json`` and ``background.ply``, whole or not at all.

A splat file edited elsewhere (SuperSplat and others) comes back into it.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.errors import PathNotFoundError, UsageError
from bridge.whole_file import write_whole
from twin.errors import UnreadableFileError
from twin.scene.gaussians import GaussianCloud, UnreadablePlyError, read_ply, write_ply

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
    """Return ``scene.json``, or None when there is no scene yet.

    Raises:
        UnreadableSceneError: When it cannot be understood.
    """
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
    """The hash that verdicts, replays, localisations and views name a run's scene by.

    Raises:
        UnreadableSceneError: When ``scene.json`` cannot be understood.
    """
    record = read_record(run)
    return None if record is None else str(record["scene_hash"])


def background_hash(run: RunFolder) -> str:
    """Name of the scene whose background lies in the folder now."""
    return provenance.hash_file(run.scene_dir / BACKGROUND)[:HASH_DIGITS]


def read_scene(run: RunFolder) -> Scene:
    """Load the rebuilt scene of a run.

    Raises:
        PathNotFoundError: When the run was not rebuilt yet.
        UnreadableSceneError: When ``scene.json`` cannot be understood, or describes another
            background than the one that lies beside it.
        UnreadablePlyError: When the background is damaged.
    """
    record = read_record(run)
    if record is None:
        raise PathNotFoundError(
            path=run.scene_dir / SCENE_FILE, what="scene", hint="Make it: robot-gst rebuild RUN."
        )
    scene = Scene(record=record, background=read_ply(run.scene_dir / BACKGROUND))
    if background_hash(run) != scene.scene_hash:
        found = f"describes scene {scene.scene_hash}, {BACKGROUND} is {background_hash(run)}"
        hint = (
            f"If you edited it: robot-gst import splats {BACKGROUND} RUN. "
            "Otherwise make it again: robot-gst rebuild RUN --force."
        )
        raise UnreadableSceneError(path=run.scene_dir / SCENE_FILE, found=found, hint=hint)
    return scene


def write_record(run: RunFolder, record: Mapping[str, Any]) -> Path:
    """Write ``scene.json`` last, by renaming: it vouches for everything else in the folder.

    Args:
        run: Whose scene folder is written.
        record: The content of ``scene.json``.
    """
    path = run.scene_dir / SCENE_FILE
    write_whole(path, (json.dumps(record, indent=2) + "\n").encode())
    return path


SPLATS = "gaussians.ply"
EDITED = "splats were edited: what was said of each Gaussian no longer fits; rebuild to say it anew"


def take_back(run: RunFolder, file: Path, object_id: str = "") -> dict[str, Any]:
    """Make a splat file the scene's background, or the Gaussians of one of its objects.

    The file is read first, so a bad one changes nothing. It may have other Gaussians than before,
    more or fewer, lack normals and harmonics, or have harmonics of degree 1 to 3. Its frame must be
    the one the file had when it left. A new background is a new scene: it has another hash. The
    views held out of the fit still show, and name, the old one. What was said of each Gaussian
    (names, parts, features) is dropped unless all of them are where they were, in the same order:
    it would be said of others.

    Args:
        run: Run folder with a rebuilt scene.
        file: PLY file; may be the scene's own, edited in place.
        object_id: Object whose Gaussians they are; empty: the background.

    Returns:
        What was taken, as ``scene.json`` keeps it under ``edited``.

    Raises:
        PathNotFoundError: No such file, or no scene yet.
        UnreadablePlyError: Another kind of file, a damaged one, or one without Gaussians.
        UsageError: The scene has no such object.
    """
    record = read_record(run)
    if record is None:
        raise PathNotFoundError(
            path=run.scene_dir / SCENE_FILE, what="scene", hint="Make it: robot-gst rebuild RUN."
        )
    known = list(record.get("objects", {}))
    if object_id and object_id not in known:
        message = f"the scene has no object {object_id!r}. It has: {', '.join(known) or 'none'}."
        raise UsageError(message)
    digest = provenance.hash_file(file) if file.is_file() else ""
    cloud = read_ply(file)
    if len(cloud) == 0:
        raise UnreadablePlyError(path=file, found="no Gaussians in it")
    about = {
        "part": object_id or "background",
        "file": file.name,
        "sha256": digest,
        "num_splats": len(cloud),
        "from_scene": record["scene_hash"],
    }
    own = record["objects"][object_id]["files"].get(SPLATS) if object_id else record["scene_hash"]
    if digest[: len(own)] == own and own:
        return about | {"scene_hash": record["scene_hash"]}  # the scene's own file, not edited
    place = run.scene_dir / BACKGROUND
    if object_id:
        place = run.scene_dir / "objects" / check_episode_id(object_id) / SPLATS
    if not _same_places(place, cloud, digest):
        _drop_semantics(run, record)
    write_ply(place, cloud)
    if object_id:
        item = record["objects"][object_id]
        item["num_splats"] = len(cloud)
        item["files"][SPLATS] = provenance.hash_file(place)
    else:
        record["scene_hash"] = background_hash(run)
        record["background"] = {"file": BACKGROUND, "num_splats": len(cloud)}
    record["edited"] = [*record.get("edited", []), about]
    write_record(run, record)
    return about | {"scene_hash": record["scene_hash"]}


def _same_places(before: Path, cloud: GaussianCloud, digest: str) -> bool:
    """Whether a cloud has the Gaussians of a file where they were; unknown if edited in place."""
    if not before.is_file() or provenance.hash_file(before) == digest:
        return False
    try:
        old = read_ply(before)
    except UnreadablePlyError:
        return False
    return len(old) == len(cloud) and np.allclose(old.means_m, cloud.means_m, atol=1e-6)


def _drop_semantics(run: RunFolder, record: dict[str, Any]) -> None:
    about = record.get("semantics") or {}
    named = [about, about.get("features") or {}, about.get("vectors") or {}]
    for name in {str(item["file"]) for item in named if "file" in item}:
        (run.scene_dir / Path(name).name).unlink(missing_ok=True)
    if about:
        record["semantics"] = {"source": about.get("source"), "remark": EDITED, "instances": []}


def describe_edit(about: Mapping[str, Any]) -> str:
    """One line for a person."""
    changed = "" if about["scene_hash"] == about["from_scene"] else f", was {about['from_scene']}"
    return (
        f"{about['part']}: {about['num_splats']} Gaussians from {about['file']}; "
        f"scene {about['scene_hash']}{changed}"
    )
