"""A URDF text as others can load it: every mesh an absolute path that exists."""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass

from bridge.task.robot import resolve_mesh
from twin.errors import TwinError

_MIMIC_DEFAULTS = (("multiplier", "1"), ("offset", "0"))


class RobotDescriptionError(TwinError):
    """A URDF text cannot be used."""

    def __init__(self, *, found: str, hint: str) -> None:
        """Remember what was found."""
        self.found = found
        super().__init__(f"the robot description {found}. {hint}")


@dataclass(frozen=True, kw_only=True)
class Mimic:
    """A joint that goes where another one goes: multiplier * leader + offset."""

    joint: str
    leader: str
    multiplier: float
    offset: float


def mimicked(urdf: str) -> list[Mimic]:
    """Read the joints that follow another joint, which pinocchio takes for free ones.

    Raises:
        RobotDescriptionError: When one follows a joint that is not there, or follows another one
            itself, or by a number that is none.
    """
    root = parse_description(urdf)
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    followers = {
        name: element
        for name, joint in joints.items()
        if (element := joint.find("mimic")) is not None
    }
    return [
        _mimic(name, element, set(joints) - set(followers)) for name, element in followers.items()
    ]


def _mimic(name: str, element: ET.Element, leaders: set[str]) -> Mimic:
    leader = element.get("joint", "")
    if leader not in leaders:
        raise RobotDescriptionError(
            found=f"lets the joint {name!r} mimic {leader!r}, which is not there or mimics another",
            hint="Let it mimic a joint that moves by itself.",
        )
    try:
        numbers = [float(element.get(key, default)) for key, default in _MIMIC_DEFAULTS]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise RobotDescriptionError(
            found=f"lets the joint {name!r} mimic {leader!r} by something that is no number",
            hint="Give multiplier and offset as numbers.",
        )
    multiplier, offset = numbers
    return Mimic(joint=name, leader=leader, multiplier=multiplier, offset=offset)


def with_absolute_meshes(urdf: str, *, keep_visuals: bool = False) -> str:
    """Replace ``package://`` URIs by paths; visuals are dropped unless they are wanted.

    Raises:
        RobotDescriptionError: When the text is not a URDF.
        UsageError: When a mesh is not there, or is in an unknown package.
    """
    root = parse_description(urdf)
    for link in root.findall("link"):
        if not keep_visuals:
            for visual in link.findall("visual"):
                link.remove(visual)
        for mesh in link.iter("mesh"):
            mesh.set("filename", str(resolve_mesh(mesh.get("filename", ""))))
    return ET.tostring(root, encoding="unicode")


def parse_description(urdf: str) -> ET.Element:
    """Parse a URDF text. Raises ``RobotDescriptionError`` when it is none or parts lack names."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise RobotDescriptionError(
            found=f"is not XML ({error})",
            hint="Record the robot's URDF on /robot_description, or attach it as robot.urdf.",
        ) from error
    if root.tag != "robot":
        raise RobotDescriptionError(
            found=f"has the root element <{root.tag}>, not <robot>",
            hint="Expand xacro files before publishing them.",
        )
    _check_names(root)
    return root


def _check_names(root: ET.Element) -> None:
    """Readers of URDF that meet a part without a name may take the process with them."""
    for tag in ("link", "joint"):
        names = [element.get("name", "").strip() for element in root.findall(tag)]
        if "" in names:
            raise RobotDescriptionError(
                found=f"has a {tag} without a name", hint="Name every link and joint."
            )
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise RobotDescriptionError(
                found=f"has more than one {tag} named {', '.join(twice)}",
                hint="Give each a name of its own.",
            )
