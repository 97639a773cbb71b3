"""The default robot's description: a UR5 from ``example-robot-data`` with our parallel gripper.

Nothing of the UR5 is copied into this project: its URDF is read from the installed data package
and the gripper (``datasets/robots/parallel_gripper.urdf``) is hung on ``tool0``.
"""

import re
import sysconfig
import xml.etree.ElementTree as ET
from pathlib import Path

from bridge.errors import MissingDependencyError, UsageError
from bridge.task.data import dataset_file

ROBOT_NAME = "ur5_parallel_gripper"
BASE_FRAME = "base_link"
TCP_FRAME = "tcp"
ARM_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
FINGER_JOINTS = ("gripper_left_finger_joint", "gripper_right_finger_joint")
FINGER_LINKS = ("gripper_left_finger", "gripper_right_finger")
GRIPPER = "gripper"
"""What task files call the fingers and what carries them."""
GRIPPER_LINKS = ("gripper_base", *FINGER_LINKS)
MAX_WIDTH_M = 0.085
"""Finger distance when open; each finger joint is at half of it."""

_PACKAGE = "example-robot-data"


def _data_root() -> Path:
    root = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix" / "share" / _PACKAGE
    if not root.is_dir():
        raise MissingDependencyError(
            package=_PACKAGE, extra="twin", purpose="the default robot (UR5)"
        )
    return root


def _ur5_path() -> Path:
    return _data_root() / "robots" / "ur_description" / "urdf" / "ur5_robot.urdf"


def ur5_urdf() -> str:
    """Return the URDF text of the bare arm, as its data package holds it."""
    return _ur5_path().read_text()


def ur5_with_gripper_urdf() -> str:
    """Return the URDF text; mesh names stay ``package://`` URIs, see ``resolve_mesh``."""
    arm = ET.parse(_ur5_path()).getroot()
    gripper = ET.parse(dataset_file("robots", "parallel_gripper", ".urdf")).getroot()
    for element in [item for item in arm if item.tag in ("transmission", "gazebo")]:
        arm.remove(element)
    arm.extend(list(gripper))
    arm.set("name", ROBOT_NAME)
    return ET.tostring(arm, encoding="unicode")


def resolve_mesh(uri: str) -> Path:
    """Turn a ``package://example-robot-data/...`` URI or a plain path into a file that exists.

    Raises:
        UsageError: Another package, or a path that leaves the data folder.
    """
    match = re.fullmatch(r"package://([^/]+)/(.+)", uri)
    if match is None:
        path = Path(uri.removeprefix("file://"))
    elif match[1] == _PACKAGE:
        path = (_data_root() / match[2]).resolve()
        if not path.is_relative_to(_data_root().resolve()):
            message = f"mesh {uri!r} leaves its package folder."
            raise UsageError(message)
    else:
        message = f"mesh {uri!r} is in package {match[1]!r}; only {_PACKAGE!r} is known here."
        raise UsageError(message)
    if not path.is_file():
        message = f"mesh {uri!r} is not there ({path})."
        raise UsageError(message)
    return path
