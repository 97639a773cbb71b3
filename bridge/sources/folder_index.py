"""Which layout an RGB-D folder has, and its frames.

Three layouts are told apart by their files: our own index ``scene.json``, the lists of the TUM
RGB-D benchmark (``rgb.txt`` and ``depth.txt``, or ``associations.txt``), and the numbered files of
7-Scenes (``frame-000000.color.png``). ``docs/rgbd_folder.md`` describes each.
"""

from pathlib import Path

from bridge.errors import PathNotFoundError
from bridge.sources.errors import FolderError
from bridge.sources.folder_config import FolderConfig
from bridge.sources.folder_record import FolderIndex
from bridge.sources.folder_scene import INDEX_NAME, read_scene
from bridge.sources.folder_sevenscenes import find_frames, read_sevenscenes
from bridge.sources.folder_tum import find_lists, read_tum

DEFAULTS = FolderConfig()


def read_index(folder: Path, config: FolderConfig = DEFAULTS) -> FolderIndex:
    """Find out a folder's layout and read it; every image it names must exist.

    Args:
        folder: The folder.
        config: Intrinsics and depth unit for layouts that do not hold them.

    Raises:
        PathNotFoundError: When the folder or an image is not there.
        FolderError: When the layout is unknown, or something in it makes no sense.
    """
    if not folder.is_dir():
        raise PathNotFoundError(
            path=folder, what="RGB-D folder", hint="Give a folder of one of the known layouts."
        )
    if (folder / INDEX_NAME).is_file():
        return read_scene(folder, config)
    if find_lists(folder):
        return read_tum(folder, config)
    if find_frames(folder):
        return read_sevenscenes(folder, config)
    raise _unknown(folder)


def _unknown(folder: Path) -> FolderError | PathNotFoundError:
    """Say what was looked for, and where it may be instead."""
    below = sorted(
        path.name
        for path in folder.iterdir()
        if path.is_dir() and ((path / INDEX_NAME).is_file() or find_lists(path))
    )
    below += sorted(path.name for path in folder.iterdir() if path.is_dir() and find_frames(path))
    if below:
        return FolderError(
            path=folder,
            found=f"no frames of its own, but {', '.join(below[:5])} below it hold some",
            hint="Give one of those folders.",
        )
    return PathNotFoundError(
        path=folder / INDEX_NAME,
        what="index",
        hint=(
            "Known layouts: scene.json; TUM (rgb.txt, depth.txt, groundtruth.txt); 7-Scenes "
            "(frame-000000.color.png, .depth.png, .pose.txt). docs/rgbd_folder.md describes them."
        ),
    )
