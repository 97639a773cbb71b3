"""What a robot is: joints, frames, gripper, limits; read from ``datasets/robots/*.toml``.

A robot file names a URDF, by package or by path, and what a URDF cannot say: which joints are the
arm's and in which order, which frame is the base and which the tool, how far the fingers are open.
``default`` holds the robot that is meant where nobody names another.
"""

import math
import re
import sysconfig
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bridge.data_files import dataset_file
from bridge.errors import MissingDependencyError, UsageError

SCHEMA_VERSION = 1
Width = TypeVar("Width", float, np.ndarray)
PACKAGE = "example-robot-data"
"""The package of robot descriptions that ``package://`` may name."""


@dataclass(frozen=True, kw_only=True)
class Finger:
    """A joint that opens the gripper; its value grows linearly with the width."""

    joint: str
    closed: float = 0.0
    """Value when the width is 0 [m or rad]."""
    per_m: float = 0.5
    """Change of the value with the width [m/m or rad/m]; 0.5: one of two that slide."""

    def value(self, width_m: Width) -> Width:
        """Where the joint is at a distance between the pads, or at several [m or rad]."""
        return self.closed + self.per_m * width_m


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """What takes hold of objects; without fingers it is a fixed tool."""

    name: str = "gripper"
    """What task files call the fingers and what carries them."""
    links: tuple[str, ...] = ()
    """The fingers and what carries them."""
    finger_links: tuple[str, ...] = ()
    fingers: tuple[Finger, ...] = ()
    """Joints that are driven: two, or one that the others follow by ``mimic`` in the URDF."""
    max_width_m: float = 0.0
    """Distance between the pads when open."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A serial arm with what hangs on its flange."""

    name: str
    urdf: str
    """``package://PACKAGE/PATH``, or a path, relative to the robot file."""
    attached: tuple[str, ...] = ()
    """URDF files whose links and joints are added: gripper, tool. Each is mounted by a joint of its
    own whose parent is a link of the arm."""
    joints: tuple[str, ...]
    """The arm's, base to flange: the order of every array of joint values."""
    base_frame: str = "base_link"
    """Plans, objects and cameras are given in it."""
    tool_frame: str = "tcp"
    """What plans move: between the pads of a gripper."""
    gripper: Gripper = Gripper()
    payload_kg: float | None = None
    """What it may carry, without its gripper; None: not known."""
    velocity_rad_s: tuple[float, ...] | None = None
    """Limit of each joint [rad/s]; None: those of the URDF."""
    acceleration_rad_s2: tuple[float, ...] | None = None
    tool_speed_m_s: float | None = None
    """Fastest its tool may be commanded [m/s]; None: not known."""
    contact_force_N: float | None = None
    """Force on the arm beyond which it stops by itself; None: not known."""
    tracking_error_rad: float | None = None
    """How far a joint may be from where it is commanded before the arm stops by itself."""
    hulls: str = ""
    """Folder of convex hulls, ``<link>.ply``; "": they are made from the collision meshes."""
    folder: Path = Path()
    """Where the robot file lies."""

    def arm_urdf(self) -> str:
        """Return the URDF text of the bare arm, as its package or file holds it."""
        return self._file(self.urdf).read_text()

    def urdf_text(self) -> str:
        """Return the URDF text with all that is attached; mesh names stay as they are."""
        arm = ET.parse(self._file(self.urdf)).getroot()
        for element in [item for item in arm if item.tag in ("transmission", "gazebo")]:
            arm.remove(element)
        for name in self.attached:
            arm.extend(list(ET.parse(self._file(name)).getroot()))
        arm.set("name", self.name)
        return ET.tostring(arm, encoding="unicode")

    def _file(self, uri: str) -> Path:
        if uri.startswith("package://"):
            return resolve_mesh(uri)
        return resolve_mesh(str(self.folder / uri))


def read_robot(name: str) -> Robot:
    """Read a robot file by its name in ``datasets/robots``, or by its path.

    Raises:
        UsageError: No such robot, or a file that does not describe one.
    """
    path = dataset_file("robots", name)
    try:
        table = tomllib.loads(path.read_text())
        if table.pop("schema_version", None) != SCHEMA_VERSION:
            raise ValueError(f"schema_version is not {SCHEMA_VERSION}")
        gripper = dict(table.pop("gripper", {}))
        fingers = [_record(Finger, item) for item in gripper.pop("fingers", ())]
        robot: Robot = _record(
            Robot,
            {**table, "folder": path.parent},
            gripper=_record(Gripper, gripper, fingers=tuple(fingers)),
        )
        _check(robot)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, TypeError, ValueError) as error:
        raise UsageError(f"{path} is not a robot file: {error}.") from error
    return robot


def _record(kind: type, table: dict[str, Any], **made: Any) -> Any:
    unknown = table.keys() - {field.name for field in fields(kind)}
    if unknown:
        raise ValueError(f"{kind.__name__.lower()} has no {', '.join(sorted(unknown))}")
    values = {key: tuple(item) if isinstance(item, list) else item for key, item in table.items()}
    return kind(**values, **made)


def _check(robot: Robot) -> None:
    gripper = robot.gripper
    joints = (*robot.joints, *(finger.joint for finger in gripper.fingers))
    named: dict[str, tuple[object, ...]] = {"joints": joints, "links": gripper.links}
    for what, values in named.items():
        if not all(isinstance(item, str) and item for item in values):
            raise ValueError(f"{what} must be names")
        if len(set(values)) != len(values):
            raise ValueError(f"{what} are named twice: {', '.join(map(str, values))}")
    if not robot.joints:
        raise ValueError("it has no joints")
    if not set(gripper.finger_links) <= set(gripper.links):
        raise ValueError("finger_links must be among the gripper's links")
    if gripper.fingers and not gripper.max_width_m > 0:
        raise ValueError("a gripper with fingers needs max_width_m")
    for what in ("velocity_rad_s", "acceleration_rad_s2"):
        limits: Iterable[float] | None = getattr(robot, what)
        if limits is not None:
            limits = tuple(limits)
            if len(limits) != len(robot.joints) or not all(0 < x < math.inf for x in limits):
                raise ValueError(f"{what} must hold one positive number per joint")
    for what in ("tool_speed_m_s", "contact_force_N", "tracking_error_rad"):
        limit = getattr(robot, what)
        if limit is not None and not 0 < limit < math.inf:
            raise ValueError(f"{what} must be a positive number")


def resolve_mesh(uri: str) -> Path:
    """Turn a ``package://example-robot-data/...`` URI or a plain path into a file that exists.

    Raises:
        UsageError: Another package, or a path that leaves the data folder.
        MissingDependencyError: The package is not installed.
    """
    match = re.fullmatch(r"package://([^/]+)/(.+)", uri)
    if match is None:
        path = Path(uri.removeprefix("file://"))
    elif match[1] == PACKAGE:
        root = _data_root()
        path = (root / match[2]).resolve()
        if not path.is_relative_to(root.resolve()):
            raise UsageError(f"mesh {uri!r} leaves its package folder.")
    else:
        raise UsageError(
            f"mesh {uri!r} is in package {match[1]!r}; only {PACKAGE!r} is known here."
        )
    if not path.is_file():
        raise UsageError(f"mesh {uri!r} is not there ({path}).")
    return path


def _data_root() -> Path:
    root = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix" / "share" / PACKAGE
    if not root.is_dir():
        raise MissingDependencyError(
            package=PACKAGE, extra="replay", purpose="the default robot (UR5)"
        )
    return root
