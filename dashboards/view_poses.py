"""Where the cameras of views stood, for a map: from an episode, or from files beside the images."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, PathNotFoundError
from bridge.sources.folder.posed_index import TRANSFORMS, read_posed_index
from dashboards.errors import DashboardError
from dashboards.twin_page import source_of
from twin.scene.render import poses_in_scene
from twin.scene.store.folder import read_scene

SPLAT_CAMERAS = "cameras.json"
"""Beside a model of the reference implementation of 3D Gaussian splatting: held-out cameras come
first, and its renders are numbered in that order (github.com/graphdeco-inria/gaussian-splatting,
``scene/__init__.py``, ``utils/camera_utils.py`` and ``render.py``)."""
HELD_OUT, FITTED = "test", "train"
ABOVE = 4
"""Folders above one of images in which poses are looked for: ``model/test/ours_7000/renders``."""
Poses = dict[str, Float[np.ndarray, "4 4"]]
"""``T_world_camera`` by view; +Z forward, +Y down."""


def poses_beside(folders: Iterable[Path], views: Iterable[str]) -> tuple[Poses, str]:
    """Look for poses of views in the folders of images and above them.

    Args:
        folders: Of images, the reference first.
        views: Names of the images without their endings.

    Returns:
        What was found, and where; or nothing and what was looked for.
    """
    names, problems = list(views), []
    for folder in folders:
        for place in (folder, *list(folder.parents)[:ABOVE]):
            try:
                found = _poses_of(place, folder, names)
            except (GstError, OSError) as error:
                problems.append(str(error))
                continue
            if found:
                return found, str(place)
    looked_for = (
        f"there is no {TRANSFORMS}, no text model of COLMAP and no {SPLAT_CAMERAS} of these views "
        "in the folders of the images or above them"
    )
    return {}, problems[0] if problems else looked_for


def _poses_of(place: Path, folder: Path, views: list[str]) -> Poses:
    if (place / SPLAT_CAMERAS).is_file():
        return _splat_cameras(place / SPLAT_CAMERAS, folder, views)
    try:
        index = read_posed_index(place)
    except PathNotFoundError:
        if (place / TRANSFORMS).is_file():
            raise
        return {}
    by_name = {image.path.stem: image.T_world_camera for image in index.images}
    return {view: by_name[_stem(view)] for view in views if _stem(view) in by_name}


def _stem(view: str) -> str:
    return view.rpartition("/")[2]


def _splat_cameras(path: Path, folder: Path, views: list[str]) -> Poses:
    """By the names of the images, else by their numbers.

    Raises:
        DashboardError: When the file is something else.
    """
    try:
        records = json.loads(path.read_text())
        Ts = [_splat_pose(record) for record in records]
        names = [Path(str(record["img_name"])).stem for record in records]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        message = f"{path} is no list of cameras ({error!r})."
        raise DashboardError(message) from error
    by_name = dict(zip(names, Ts, strict=True))
    if all(_stem(view) in by_name for view in views):
        return {view: by_name[_stem(view)] for view in views}
    below = folder.relative_to(path.parent).parts[:1]
    if not all(_stem(view).isdecimal() for view in views) or below not in ((HELD_OUT,), (FITTED,)):
        return {}
    first = 0 if below == (HELD_OUT,) else len(Ts) - len(views)
    places = {view: first + int(_stem(view)) for view in views}
    return {view: Ts[place] for view, place in places.items() if 0 <= place < len(Ts)}


def _splat_pose(record: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3] = np.array(record["rotation"], dtype=np.float64)
    T[:3, 3] = np.array(record["position"], dtype=np.float64)
    if not np.isfinite(T).all():
        message = "a pose is not finite"
        raise ValueError(message)
    return T


def poses_of_run(run: RunFolder, views: Iterable[str]) -> tuple[Poses, str]:
    """Find the cameras of a run's held-out views, where its scene has them.

    Args:
        run: The run folder.
        views: ``camera/stamp_ns``.

    Returns:
        What was found, and where; or nothing and why.
    """
    wanted: dict[str, list[int]] = {}
    for view in views:
        camera, _, stamp = view.rpartition("/")
        if camera and stamp.isdecimal():
            wanted.setdefault(camera, []).append(int(stamp))
    why = "the run holds no held-out views"
    found: Poses = {}
    for path in run.derived("*.views.*"):
        try:
            source = source_of(run, path)
            if source is None:
                continue
            scene, episode = read_scene(run), Episode.open(source)
            for camera, stamps in wanted.items():
                stamps_ns = np.array(sorted(stamps), dtype=np.int64)
                tree = poses_in_scene(run, scene, episode, camera, stamps_ns)
                frame_id = streams.camera_info(episode, camera).frame_id
                Ts = tree.Ts_root_frame(frame_id, stamps_ns)
                found |= {f"{camera}/{ns}": T for ns, T in zip(stamps_ns.tolist(), Ts, strict=True)}
            return found, source.name
        except GstError as error:
            why = str(error)
    return found, why
