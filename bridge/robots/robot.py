"""What a robot is: joints, frames, gripper, limits; read from ``datasets/robots/*.toml``.

A robot file names a URDF, by package or by path, and what a URDF cannot say: which joints are the
arm's and in which order, which frame is the base and which the tool, how far the fingers are open.
The record travels inside the description (``Robot.description``), so that whoever receives a URDF
knows whose it is. Every field is explained in docs/robots.md.
"""

import json
import math
import re
import sysconfig
import tomllib
import typing
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from difflib import get_close_matches
from functools import lru_cache
from html import unescape
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from bridge.data_files import dataset_file, datasets_folder
from bridge.errors import MissingDependencyError, UsageError
from bridge.leaves import load_leaf

SCHEMA_VERSION = 1
Width = TypeVar("Width", float, np.ndarray)
PACKAGE = "example-robot-data"
"""The package of robot descriptions that ``package://`` may name."""
DEFAULT_ROBOT = "ur5_parallel_gripper"
"""Whose a description is that neither carries a record nor has the name of a robot file: until
robots had files, every episode was recorded with it."""
GRIPPER_WIDTH = "gripper_width"
"""The one joint in the messages of a gripper's state: the distance between its pads [m]."""
RECORD_TAG = "robot_gst"
"""Element of a URDF that holds the record; readers of URDF pass over what they do not know."""
NUM_JOINTS = range(5, 8)


@dataclass(frozen=True, kw_only=True)
class Finger:
    """A joint that opens the gripper, and how its value follows from the width.

    One of two laws holds: the line ``closed + per_m * width``, or with ``link_m`` the lever
    ``width = offset_m + link_m * sin(value - zero_rad)``.
    """

    joint: str
    turns: bool = False
    """Whether the joint turns; else it slides."""
    closed: float = 0.0
    """Value when the width is 0 [m or rad]."""
    per_m: float = 0.5
    """Change of the value with the width [m/m or rad/m]; 0.5: one of two that slide."""
    link_m: float = 0.0
    """Length from the joint's axis to the pad, summed over the jaws that move; negative where a
    rising value closes them; 0: no lever [m]."""
    offset_m: float = 0.0
    """Width at which the lever is parallel to the closing pads' face [m]."""
    zero_rad: float = 0.0

    def value(self, width_m: Width) -> Width:
        """Where the joint is at a distance between the pads, or at several [m or rad]."""
        if self.link_m:
            sine = np.clip((width_m - self.offset_m) / self.link_m, -1.0, 1.0)
            return typing.cast(Width, self.zero_rad + np.arcsin(sine))
        return self.closed + self.per_m * width_m

    def width(self, value: Width) -> Width:
        """The distance between the pads at a value of the joint, or at several [m]."""
        if self.link_m:
            sine = np.sin(value - self.zero_rad)
            return typing.cast(Width, self.offset_m + self.link_m * sine)
        return (value - self.closed) / self.per_m

    def slope(self, width_m: float) -> float:
        """Change of the value with the width, there [m/m or rad/m]."""
        if self.link_m:
            return 1.0 / (self.link_m * math.cos(float(self.value(width_m)) - self.zero_rad))
        return self.per_m


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """What takes hold of objects; without fingers it is a fixed tool."""

    name: str = "gripper"
    """What task files call the fingers and what carries them."""
    links: tuple[str, ...] = ()
    """The fingers and what carries them."""
    finger_links: tuple[str, ...] = ()
    """Those that close on objects."""
    fingers: tuple[Finger, ...] = ()
    """Joints that are driven: two, or one that the others follow by ``mimic`` in the URDF."""
    max_width_m: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A serial arm with what hangs on its flange."""

    name: str
    urdf: str
    """``package://PACKAGE/PATH``, or a path, relative to the robot file."""
    attached: tuple[str, ...] = ()
    """URDF files whose links and joints are added: gripper, tool. Each is mounted by a joint of its
    own whose parent is a link of the arm; a link of the arm gets the shapes it has there."""
    flange: str = ""
    """Link of the arm that attached files are mounted on; "": the one that they name."""
    joints: tuple[str, ...]
    """The arm's, base to flange: the order of every array of joint values."""
    base_frame: str = "base_link"
    """Plans, objects and cameras are given in it."""
    tool_frame: str = "tcp"
    """What plans move: between the pads of a gripper."""
    gripper: Gripper = Gripper()
    held: tuple[str, ...] = ()
    """Joints of the URDF that do not move: they, and what mimics them, become fixed, at 0."""
    may_overlap: tuple[tuple[str, str], ...] = ()
    """Pairs of links whose hulls overlap without touching."""
    home_rad: tuple[float, ...] | None = None
    """A posture free of contact, where searches begin; None: the middle of the limits."""
    payload_kg: float | None = None
    """What it may carry, without its gripper; None: not known."""
    position_rad: tuple[tuple[float, float], ...] | None = None
    """Lowest and highest value of each joint [rad]; None: those of the URDF."""
    velocity_rad_s: tuple[float, ...] | None = None
    """Limit of each joint [rad/s]; None: those of the URDF."""
    acceleration_rad_s2: tuple[float, ...] | None = None
    """Limit of each joint [rad/s2]; None: not known."""
    jerk_rad_s3: tuple[float, ...] | None = None
    """Limit of each joint [rad/s3]; None: not known."""
    interpolation: Literal["linear", "cubic", "quintic"] = "linear"
    """How the controller goes from waypoint to waypoint."""
    tool_speed_m_s: float | None = None
    """Fastest its tool may be commanded [m/s]; None: not known. This and what follows is where the
    arm stops by itself: its safety settings."""
    elbow_speed_m_s: float | None = None
    momentum_kg_m_s: float | None = None
    power_W: float | None = None
    stop_time_s: float | None = None
    contact_force_N: float | None = None
    """Force on the arm beyond which it stops by itself; None: not known."""
    tracking_error_rad: float | None = None
    """How far a joint may be from where it is commanded before the arm stops by itself."""
    mesh_folders: Mapping[str, str] = field(default_factory=dict)
    """Folders, relative to the robot file, of other packages that ``package://`` names."""
    folder: Path = Path()

    @property
    def finger_joints(self) -> tuple[str, ...]:
        """Joints of the fingers that are driven."""
        return tuple(finger.joint for finger in self.gripper.fingers)

    def arm_urdf(self) -> str:
        """Return the URDF text of the bare arm, as its package or file holds it."""
        return self._file(self.urdf).read_text()

    def urdf_text(self, lost: list[str] | None = None) -> str:
        """Return the URDF text with all that is attached.

        Meshes of packages that are not known everywhere become paths; ``lost`` is as in ``parsed``.

        Raises:
            UsageError: A file or a mesh is missing, or an attached file hangs on nothing.
        """
        arm = self.parsed(self.urdf, lost)
        for element in arm.findall("transmission"):
            arm.remove(element)
        for name in self.attached:
            part = self.parsed(name, lost)
            self._mount(part, arm, name)
            there = {link.get("name"): link for link in arm.findall("link")}
            for item in part:
                known = there.get(item.get("name")) if item.tag == "link" else None
                arm.append(item) if known is None else known.extend(list(item))
        for joint in arm.findall("joint"):
            mimics = [m for m in joint.findall("mimic") if not number_of(m.get("offset", "0"))]
            if {joint.get("name"), *(m.get("joint") for m in mimics)} & set(self.held):
                joint.set("type", "fixed")
        arm.set("name", self.name)
        return ET.tostring(arm, encoding="unicode")

    def description(self, lost: list[str] | None = None) -> str:
        """Return the URDF text with this record in it: what is published and recorded.

        A URDF of the default robot needs none.
        """
        text = self.urdf_text(lost)
        if self.name == DEFAULT_ROBOT:
            return text
        record = {key: value for key, value in asdict(self).items() if key not in _OF_FILES}
        root = ET.fromstring(text)
        ET.SubElement(root, RECORD_TAG).text = json.dumps(record, separators=(",", ":"))
        return ET.tostring(root, encoding="unicode")

    def parsed(self, uri: str, lost: list[str] | None = None) -> ET.Element:
        """Read a URDF, its meshes as paths; UsageError says what is wrong with it.

        ``lost`` takes what is said of meshes that are not there; their shapes are left out.
        """
        path = self._file(uri)
        text = _UNREAD.sub(lambda found: b"\n" * found[0].count(b"\n"), path.read_bytes())
        if b"<xacro:" in text:
            raise UsageError(
                f"{path} is a xacro file; expand it first: xacro {path} > {path.stem}.urdf, and "
                "name that."
            )
        try:
            root = ET.fromstring(text)
        except (ET.ParseError, ValueError, LookupError) as error:  # an encoding, too
            raise UsageError(f"{path} is not XML ({error}).") from error
        if root.tag != "robot":
            raise UsageError(f"{path} has the root element <{root.tag}>, not <robot>.")
        missing = [] if lost is None else lost
        for link, shape in [(each, part) for each in root.iter("link") for part in each]:
            for mesh in shape.iter("mesh"):
                try:
                    found = self._mesh(mesh.get("filename", ""), path.parent)
                    mesh.set("filename", found)
                    if lost is not None:
                        resolve_mesh(found)
                except UsageError as error:
                    if shape.tag != "visual":  # nothing here is drawn from those
                        missing.append(f"the link {link.get('name')!r}: {error}")
                        link.remove(shape)
        if missing and lost is None:
            raise UsageError(" ".join(missing))
        return root

    def _mesh(self, uri: str, folder: Path) -> str:
        """Leave the meshes of the known package; find those of others."""
        match = re.fullmatch(r"package:/{2,}([^/]+)/(.+)", uri)
        if match is None:
            path = Path(uri.removeprefix("file://"))
            return str(resolve_mesh(str(path if path.is_absolute() else folder / path)))
        if match[1] in self.mesh_folders:
            path = self.folder / self.mesh_folders[match[1]] / match[2]
            return str(resolve_mesh(str(path.resolve())))
        return uri

    def _mount(self, part: ET.Element, arm: ET.Element, name: str) -> None:
        own = {link.get("name") for link in part.findall("link")}
        links = {link.get("name") for link in arm.findall("link")}
        for parent in part.findall("joint/parent"):
            if parent.get("link") in own:
                continue
            if self.flange:
                parent.set("link", self.flange)
            mount = parent.get("link", "")
            if mount not in links:
                raise UsageError(
                    f"{name} hangs on {mount!r}, which the arm of {self.name!r} lacks. Set flange "
                    f"to one of: {', '.join(str(link) for link in sorted(links, key=str))}."
                )

    def _file(self, uri: str) -> Path:
        return resolve_mesh(uri if uri.startswith("package:/") else str(self.folder / uri))


_UNREAD = re.compile(rb"<!--.*?-->|<gazebo\b[^>]*/>|<gazebo\b.*?</gazebo>", re.DOTALL)
"""Simulators read these, with prefixes that nothing declares."""
_OF_FILES = ("attached", "flange", "held", "mesh_folders", "folder")
"""Fields that say how the URDF is put together: a description is put together already."""


_ODD = (msgspec.ValidationError, AttributeError, TypeError, ValueError)
"""What a record that is not a robot raises."""


def read_robot(name: str) -> Robot:
    """Read a robot file by its name in ``datasets/robots``, or by its path; or guess at a URDF."""
    if name.endswith((".urdf", ".xacro")):
        return typing.cast(Robot, load_leaf("open", "propose")(Path(name))[0])
    path = dataset_file("robots", name)
    try:
        table = tomllib.loads(path.read_text())
        if table.pop("schema_version", None) != SCHEMA_VERSION:
            raise ValueError(f"schema_version is not {SCHEMA_VERSION}")
        return replace(_robot_from(table), folder=path.absolute().parent)
    except _ODD as error:
        raise UsageError(f"{path} is not a robot file: {error}. See docs/robots.md.") from error


@lru_cache(maxsize=16)
def robot_of(urdf: str) -> Robot:
    """Return the robot that a description is of.

    That is the record the description carries; else the robot file that has the name of the URDF,
    or alone has its joints; else the default robot, with which old episodes were recorded.
    """
    carried = re.search(rf"<{RECORD_TAG}\b[^>]*>(.*?)</{RECORD_TAG}>", urdf, re.DOTALL)
    if carried is not None:
        try:
            return _robot_from(json.loads(unescape(carried[1])))
        except _ODD as error:
            raise UsageError(
                f"the robot description carries a record that is not a robot: {error}. "
                "Name the robot's file: --robot FILE.toml."
            ) from error
    name = robot_name(urdf)
    if name in _shipped():
        return read_robot(name)
    fits = robots_with(re.findall(r'<joint\b[^>]*\bname="([^"]+)"', urdf))
    return fits[0] if len(fits) == 1 else read_robot(DEFAULT_ROBOT)


def _shipped() -> list[str]:
    return sorted(path.stem for path in (datasets_folder() / "robots").glob("*.toml"))


def robots_with(joints: Iterable[str], known: Sequence[Robot] = ()) -> list[Robot]:
    """Robots, of the robot files unless others are given, that have only these joints.

    Of several, those that have the most of them.
    """
    there = set(joints)
    known = known or [read_robot(name) for name in _shipped()]
    fits = [robot for robot in known if there.issuperset(robot.joints)]
    return [robot for robot in fits if len(robot.joints) == max(len(r.joints) for r in fits)]


@dataclass(frozen=True, kw_only=True)
class Mimic:
    """A joint of a URDF that goes where another one goes: multiplier * leader + offset."""

    joint: str
    leader: str
    multiplier: float = 1.0
    offset: float = 0.0


def mimics_of(urdf: str) -> tuple[Mimic, ...]:
    """Read the joints of a URDF that follow another one; what is not a number becomes NaN."""
    found = []
    for joint in ET.fromstring(urdf).findall("joint"):
        element = joint.find("mimic")
        if element is not None:
            numbers = (element.get("multiplier", "1"), element.get("offset", "0"))
            multiplier, offset = map(number_of, numbers)
            found.append(
                Mimic(
                    joint=joint.get("name", ""),
                    leader=element.get("joint", ""),
                    multiplier=multiplier,
                    offset=offset,
                )
            )
    return tuple(found)


def number_of(text: str) -> float:
    """Read an attribute; other text becomes NaN."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def robot_name(urdf: str) -> str:
    """Return the name in a URDF's ``<robot>`` element, "" when there is none."""
    found = re.search(r"<robot\b[^>]*?\bname\s*=\s*[\"']([^\"']*)[\"']", urdf)
    return found[1] if found else ""


def _robot_from(table: Mapping[str, Any]) -> Robot:
    """Make the record of a table."""
    gripper = table.get("gripper", {})
    parts = [(Robot, "robot", table), (Gripper, "gripper", gripper)]
    parts += [(Finger, "gripper.fingers", item) for item in gripper.get("fingers", ())]
    for kind, where, part in parts:
        allowed = [item.name for item in fields(kind)]
        for key in set(part) - set(allowed):
            near = get_close_matches(key, allowed, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else "."
            raise ValueError(f"{where} has no {key}{guess} It may have: {', '.join(allowed)}")
    json.dumps(table, default=str, allow_nan=False)  # refuses numbers that are none
    robot = msgspec.convert(table, Robot)
    _check_names(robot)
    _check_numbers(robot)
    return robot


def _check_names(robot: Robot) -> None:
    gripper = robot.gripper
    named: dict[str, tuple[str, ...]] = {
        "joints": (*robot.joints, *robot.finger_joints, *robot.held),
        "links": gripper.links,
        "name": (robot.name,),
    }
    for what, values in named.items():
        if not all(value and value.isprintable() for value in values):
            raise ValueError(f"{what} must be names")
        if len(set(values)) != len(values):
            twice = sorted({name for name in values if values.count(name) > 1})
            raise ValueError(f"{what} are named twice: {', '.join(twice)}")
    if len(robot.joints) not in NUM_JOINTS:
        raise ValueError(
            f"joints lists {len(robot.joints)}; arms of {NUM_JOINTS[0]} to {NUM_JOINTS[-1]} joints "
            "are supported"
        )
    if not set(gripper.finger_links) <= set(gripper.links):
        raise ValueError("finger_links must be among the gripper's links")


_STOPS = ("tool_speed_m_s", "elbow_speed_m_s", "momentum_kg_m_s", "power_W", "stop_time_s")
_ABOVE_0 = (*_STOPS, "contact_force_N", "tracking_error_rad", "payload_kg")


def _check_numbers(robot: Robot) -> None:
    gripper, count = robot.gripper, len(robot.joints)
    if gripper.fingers and not gripper.max_width_m > 0:
        raise ValueError("a gripper with fingers needs max_width_m, the width when open")
    if gripper.fingers and len(gripper.finger_links) != 2:
        raise ValueError("a gripper with fingers needs two finger_links, between which it holds")
    for finger in gripper.fingers:
        _check_finger(finger, gripper.max_width_m)
    for what in ("velocity_rad_s", "acceleration_rad_s2", "jerk_rad_s3"):
        limits = getattr(robot, what)
        if limits is not None and (len(limits) != count or not all(x > 0 for x in limits)):
            raise ValueError(f"{what} must hold one positive number per joint")
    if robot.home_rad is not None and len(robot.home_rad) != count:
        raise ValueError("home_rad must hold one number per joint")
    ranges = robot.position_rad
    if ranges is not None and (len(ranges) != count or not all(a < b for a, b in ranges)):
        raise ValueError("position_rad must hold a lower and a higher number per joint")
    for what in _ABOVE_0:
        limit = getattr(robot, what)
        if limit is not None and not limit > 0:
            raise ValueError(f"{what} must be above 0")


def _check_finger(finger: Finger, max_width_m: float) -> None:
    if finger.link_m:
        if not finger.turns:
            raise ValueError(f"link_m of {finger.joint} is the lever of a joint that turns = true")
        ends = np.array([-finger.offset_m, max_width_m - finger.offset_m]) / finger.link_m
        if np.any(np.abs(ends) >= 1.0):
            raise ValueError(
                f"link_m of {finger.joint} is too short for widths from 0 to {max_width_m}"
            )
    elif finger.per_m == 0:
        raise ValueError(f"per_m of {finger.joint} is 0: its width says nothing")


def resolve_mesh(uri: str) -> Path:
    """Turn a ``package://example-robot-data/...`` URI or a plain path into a file that exists.

    Raises:
        UsageError: Another package, or a path that leaves the data folder.
    """
    match = re.fullmatch(r"package:/{2,}([^/]+)/(.+)", uri)
    if match is None:
        path = Path(uri.removeprefix("file://"))
    elif match[1] == PACKAGE:
        root = _data_root()
        path = (root / match[2]).resolve()
        if not path.is_relative_to(root.resolve()):
            raise UsageError(f"mesh {uri!r} leaves its package folder.")
    else:
        raise UsageError(
            f"mesh {uri!r} is in package {match[1]!r}; only {PACKAGE!r} is known here. "
            "Say where it lies under mesh_folders in the robot file."
        )
    if not path.is_file():
        raise UsageError(f"{uri!r} is not there ({path}).")
    return path


def _data_root() -> Path:
    root = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix" / "share" / PACKAGE
    if not root.is_dir():
        raise MissingDependencyError(
            package=PACKAGE, extra="replay", purpose="a robot of that package"
        )
    return root
