"""What rmw_zenoh tells about a ROS 2 graph; texts and hashes of its message types without ROS 2.

Each endpoint has a liveliness token. Its key is, in rmw_zenoh's own words (docs/design.md of
ros2/rmw_zenoh),
``@ros2_lv/<domain>/<session>/<node id>/<entity id>/<kind>/<enclave>/<namespace>/<node>`` and, for
all but nodes, ``/<topic>/<type>/<type hash>/<qos>``; slashes inside a name are written as ``%``.
Later releases may append parts; they are ignored.

Definitions of types come with rosbags. A type may differ between ROS 2 releases; its RIHS01 hash
says which definition a publisher was built with. Releases are searched newest first.
"""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from bridge.episode.schema import Schema
from bridge.errors import UsageError

NAME_PARTS = 3


def ros_schema(type_name: str, *, type_hash: str = "", folder: Path | None = None) -> Schema | None:
    """Return the ``ros2msg`` schema of a type, or None when no definition is known."""
    text = _definition(type_name, type_hash, folder)
    if text is None:
        return None
    return Schema(
        name=type_name, schema_encoding="ros2msg", message_encoding="cdr", data=text.encode()
    )


@cache
def type_hash_of(type_name: str, *, folder: Path | None = None) -> str | None:
    """Return the RIHS01 hash of the newest definition of a type, or None when none is known."""
    return next(_hashes(type_name, folder), (None, None))[0]


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
    """Read definitions before the first message; UsageError: a file that is none, or no file."""
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
    from rosbags import typesys  # noqa: PLC0415  # only where ROS 2 types are met

    return typesys


TOKENS = "@ros2_lv/**"
"""Key expression of all tokens of all domains."""
_PREFIX = "@ros2_lv"
_PARTS, _PUBLISHER, _QOS_FIELDS = 13, "MP", 3
_NUMBER = "[0-9]{0,9}"


@dataclass(frozen=True, kw_only=True)
class RosPublisher:
    """A publisher of a ROS 2 graph."""

    domain: int
    session: str
    topic: str
    dds_type: str
    """As in keys: ``std_msgs::msg::dds_::String_``."""
    type_hash: str
    """RIHS01 hash, or TypeHashNotSupported from older releases."""
    transient_local: bool
    """Late subscribers get the last messages: /tf_static, /robot_description, maps."""

    @property
    def key(self) -> str:
        """The zenoh key its messages travel on."""
        return f"{self.domain}{self.topic}/{self.dds_type}/{self.type_hash}"


def parse_token(key: str) -> RosPublisher | None:
    """Read the liveliness token of a publisher; None for anything that is not one of rmw_zenoh."""
    parts = key.split("/")
    if len(parts) < _PARTS or parts[0] != _PREFIX or "" in parts:
        return None
    if any(sign in key for sign in "*$?#"):  # would widen the questions asked about it
        return None
    _, domain, session, _, _, kind, _, *rest = parts[:_PARTS]
    topic = rest[2].replace("%", "/")
    is_latched = is_transient_local(rest[5])
    is_one = kind == _PUBLISHER and domain.isascii() and domain.isdigit() and topic[0] == "/"
    if not is_one or is_latched is None:
        return None
    return RosPublisher(
        domain=int(domain),
        session=session,
        topic=topic,
        dds_type=rest[3],
        type_hash=rest[4],
        transient_local=is_latched,
    )


def is_transient_local(text: str) -> bool | None:
    """Read ``<reliability>:<durability>:<history>,<depth>:...``; None of what is not that.

    The numbers are those of ``rmw/types.h``: durability 1 is transient local.
    """
    fields = text.split(":")
    if len(fields) < _QOS_FIELDS:
        return None
    history, _, depth = fields[2].partition(",")
    numbers = [fields[0], fields[1], history, depth]
    return fields[1] == "1" if all(re.fullmatch(_NUMBER, each) for each in numbers) else None
