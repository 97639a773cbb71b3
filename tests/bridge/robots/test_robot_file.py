"""Robot files: what they may hold, and what is refused."""

from pathlib import Path

import pytest

from bridge.errors import UsageError
from bridge.robots.default import FINGER_JOINTS, ROBOT
from bridge.robots.robot import Finger, Gripper, read_robot, resolve_mesh

ARM = """
schema_version = 1
name = "mine"
urdf = "mine.urdf"
base_frame = "left_base"
tool_frame = "left_flange"
joints = ["left_1", "left_2", "left_3", "left_4", "left_5", "left_6", "left_7"]
"""
URDF = '<robot name="other"><link name="left_base"/><transmission name="t"/></robot>'


def written(folder: Path, text: str) -> str:
    (folder / "mine.urdf").write_text(URDF)
    path = folder / "mine.toml"
    path.write_text(text)
    return str(path)


def test_the_robot_description_has_arm_gripper_and_existing_meshes() -> None:
    pytest.importorskip("pinocchio")
    text = ROBOT.urdf_text()
    assert all(f'name="{joint}"' in text for joint in FINGER_JOINTS)
    uris = {part.split('"')[0] for part in text.split('filename="')[1:]}
    assert len(uris) == 14
    assert all(resolve_mesh(uri).is_file() for uri in uris)


def test_a_mesh_uri_cannot_leave_its_package() -> None:
    with pytest.raises(UsageError, match="leaves its package"):
        resolve_mesh("package://example-robot-data/../../../../etc/passwd")
    with pytest.raises(UsageError, match="only 'example-robot-data'"):
        resolve_mesh("package://other/mesh.stl")


def test_seven_joints_with_a_prefix_and_no_fingers(tmp_path: Path) -> None:
    robot = read_robot(written(tmp_path, ARM))
    assert (len(robot.joints), robot.joints[0]) == (7, "left_1")
    assert (robot.base_frame, robot.tool_frame) == ("left_base", "left_flange")
    assert robot.gripper == Gripper()
    assert robot.arm_urdf() == URDF
    text = robot.urdf_text()
    assert 'name="mine"' in text
    assert "transmission" not in text


def test_one_coupled_finger_that_turns(tmp_path: Path) -> None:
    gripper = """
[gripper]
name = "hand"
links = ["hand", "left_finger", "right_finger"]
finger_links = ["left_finger", "right_finger"]
max_width_m = 0.1
fingers = [{ joint = "knuckle", closed = 0.8, per_m = -8.0 }]
"""
    robot = read_robot(written(tmp_path, ARM + gripper))
    assert robot.gripper.fingers == (Finger(joint="knuckle", closed=0.8, per_m=-8.0),)
    assert robot.gripper.fingers[0].value(0.0) == 0.8
    assert robot.gripper.fingers[0].value(0.1) == pytest.approx(0.0)


def test_fingers_of_the_default_robot_share_the_width() -> None:
    assert [finger.value(0.05) for finger in ROBOT.gripper.fingers] == [0.025, 0.025]


def test_an_unknown_robot_is_answered_with_those_that_exist() -> None:
    with pytest.raises(UsageError, match=r"no robot named 'r2d2'.*ur5_parallel_gripper"):
        read_robot("r2d2")
