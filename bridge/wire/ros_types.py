"""Texts and hashes of ROS 2 message types, without ROS 2: the definitions come with rosbags.

A type may differ between ROS 2 releases; its RIHS01 hash says which definition a publisher was
built with. Releases are searched newest first.
"""

from functools import cache
from pathlib import Path
from typing import Any

from bridge.episode.schema import Schema
from bridge.errors import MissingDependencyError, UsageError

NAME_PARTS = 3


def ros_schema(type_name: str, *, type_hash: str = "", folder: Path | None = None) -> Schema | None:
    """Return the ``ros2msg`` schema of a type, or None when no definition is known.

    Args:
        type_name: For example ``nav_msgs/msg/Odometry``.
        type_hash: The definition must have this RIHS01 hash; "" takes the newest.
        folder: Searched first for ``<package>/msg/<Name>.msg`` files, at any depth.

    Raises:
        MissingDependencyError: When rosbags is not installed.
        UsageError: When a file in the folder is not a message definition.
    """
    text = _definition(type_name, type_hash, folder)
    if text is None:
        return None
    return Schema(
        name=type_name, schema_encoding="ros2msg", message_encoding="cdr", data=text.encode()
    )


@cache
def type_hash_of(type_name: str, *, folder: Path | None = None) -> str | None:
    """Return the RIHS01 hash of the newest definition of a type, or None when none is known.

    Raises:
        MissingDependencyError: When rosbags is not installed.
        UsageError: When a file in the folder is not a message definition.
    """
    return next(_hashes(type_name, folder), (None, None))[0]


def is_known_definition(type_name: str, type_hash: str, *, folder: Path | None = None) -> bool:
    """Say whether any release, or the folder, has the type with exactly this hash."""
    return any(found == type_hash for found, _ in _hashes(type_name, folder))


@cache
def _definition(type_name: str, type_hash: str, folder: Path | None) -> str | None:
    for found, store in _hashes(type_name, folder):
        if type_hash in ("", found):
            return str(store.generate_msgdef(type_name, ros_version=2)[0])
    return None


def _hashes(type_name: str, folder: Path | None) -> Any:
    """Yield (hash, store) of each definition of a type; releases are loaded when needed."""
    if len(type_name.split("/")) != NAME_PARTS:
        return
    for name in _release_names():
        store = _store(name, folder if name == _release_names()[0] else None)
        try:
            found = store.hash_rihs01(type_name)
        except KeyError:  # the type, or one that it is made of, is not known to this release
            continue
        yield found, store


@cache
def _release_names() -> tuple[str, ...]:
    """Names of the releases, newest first: rosbags lists them in the order they appeared."""
    return tuple(store.name for store in reversed(_typesys().Stores) if "ROS2" in store.name)


@cache
def _store(name: str, folder: Path | None) -> Any:
    typesys = _typesys()
    store = typesys.get_typestore(typesys.Stores[name])
    if folder is not None:
        store.register(_read_folder(folder))
    return store


def read_definitions(folder: Path) -> None:
    """Read a folder of definitions now rather than at the first message.

    Raises:
        MissingDependencyError: When rosbags is not installed.
        UsageError: When a file in the folder is not a message definition, or there is none.
    """
    _store(_release_names()[0], folder)


def _read_folder(folder: Path) -> dict[str, Any]:
    typesys = _typesys()
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("msg/*.msg")):
        name = f"{path.parent.parent.name}/msg/{path.stem}"
        try:
            found.update(typesys.get_types_from_msg(path.read_text(), name))
        except (typesys.TypesysError, OSError, UnicodeDecodeError) as error:
            raise UsageError(
                f"{path} is not a ROS 2 message definition: {error}. "
                "Correct it, or take it out of the folder."
            ) from error
    if not found:
        raise UsageError(
            f"{folder} holds no message definitions. They are looked for as "
            "<package>/msg/<Name>.msg, as in a ROS 2 workspace."
        )
    return found


@cache
def _typesys() -> Any:
    try:
        from rosbags import typesys  # noqa: PLC0415  # only where ROS 2 types are met
    except ImportError as error:
        raise MissingDependencyError(
            package="rosbags", extra="record", purpose="knowing ROS 2 message types"
        ) from error
    return typesys
