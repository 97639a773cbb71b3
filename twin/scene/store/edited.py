"""A splat file edited elsewhere (SuperSplat and others) comes back into the scene."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.errors import PathNotFoundError, UsageError
from twin.scene.gaussians.cloud import GaussianCloud
from twin.scene.store.folder import (
    BACKGROUND,
    SCENE_FILE,
    background_hash,
    read_record,
    write_record,
)
from twin.scene.store.ply import UnreadablePlyError, read_ply, write_ply

SPLATS = "gaussians.ply"
EDITED = "splats were edited: what was said of each Gaussian no longer fits; rebuild to say it anew"


def take_back(run: RunFolder, file: Path, object_id: str = "") -> dict[str, Any]:
    """Make a splat file the scene's background, or the Gaussians of one of its objects.

    The file is read first, so a bad one changes nothing. It may have other Gaussians than before,
    more or fewer, lack normals and harmonics, or have harmonics of degree 1 to 3, of which degree
    1 is kept. Its frame must be the one the file had when it left. A new background is a new
    scene: it has another hash. The views held out of the fit still show, and name, the old one.
    What was said of each Gaussian (names, parts, features) is dropped unless all of them are where
    they were, in the same order: it would be said of others.

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
