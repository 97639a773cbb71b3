"""A URDF text as others can load it: every mesh an absolute path that exists."""

import xml.etree.ElementTree as ET

from bridge.task.robot import resolve_mesh
from twin.errors import TwinError


class RobotDescriptionError(TwinError):
    """A URDF text cannot be used."""

    def __init__(self, *, found: str, hint: str) -> None:
        """Remember what was found."""
        self.found = found
        super().__init__(f"the robot description {found}. {hint}")


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
    """Parse a URDF text. Raises ``RobotDescriptionError`` when it is none."""
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
    return root
