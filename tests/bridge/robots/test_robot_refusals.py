"""What a robot file may hold, field by field, and how one that may not is refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bridge.data_files import datasets_folder
from bridge.errors import UsageError
from bridge.robots.robot import DEFAULT_ROBOT, Finger, Robot, read_robot, robot_of

ROBOTS = sorted(path.stem for path in (datasets_folder() / "robots").glob("*.toml"))
ARM = """
schema_version = 1
name = "mine"
urdf = "mine.urdf"
base_frame = "base"
tool_frame = "flange"
joints = ["j1", "j2", "j3", "j4", "j5", "j6"]
"""
GRIPPER = """
[gripper]
links = ["left", "right"]
finger_links = ["left", "right"]
max_width_m = 0.1
"""
URDF = """<robot name="other"><link name="base"/><link name="flange">
<visual><geometry><mesh filename="package://mine/flange.stl"/></geometry></visual></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="flange"/></joint></robot>"""


def read(folder: Path, text: str, urdf: str = URDF) -> Robot:
    (folder / "mine.urdf").write_text(urdf)
    (folder / "mine.toml").write_text(text)
    return read_robot(str(folder / "mine.toml"))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (ARM + "tool_fram = 'x'\n", r"robot has no tool_fram; did you mean 'tool_frame'\?.*joints"),
        (ARM + "payload_kg = 'much'\n", r"Expected .float . null., got .str. - at .*payload_kg"),
        (ARM + "payload_kg = -1.0\n", "payload_kg must be above 0"),
        (ARM + "payload_kg = nan\n", "Out of range float"),
        (ARM + "home_rad = [0.0, 1.0]\n", "home_rad must hold one number per joint"),
        (ARM + "position_rad = [[1.0, -1.0]]\n", "position_rad must hold"),
        (ARM + "may_overlap = [['a']]\n", "array. of length 2, got 1"),
        (ARM + "velocity_rad_s = [1.0, 2.0]\n", "one positive number per joint"),
        (ARM.replace("schema_version = 1", "schema_version = 2"), "schema_version"),
        ('schema_version = 1\nname = "mine"\nurdf = "mine.urdf"\n', "joints"),
        ("joints = [", "not a robot file"),
        (ARM.replace('"j2"', '"j1"'), "named twice"),
        (ARM.replace('"j6"', '"j6", "j7", "j8"'), "joints lists 8"),
        (ARM.replace(', "j5", "j6"', ""), "joints lists 4"),
        (ARM.replace('"j6"', "6"), "Expected .str., got .int."),
        (ARM + GRIPPER.replace("max_width_m = 0.1", "fingers = [{ joint = 'a' }]"), "max_width_m"),
        (ARM + "[gripper]\njaws = 2\n", "gripper has no jaws"),
        (ARM + "[gripper]\nfinger_links = ['a']\n", "among the gripper's links"),
        (ARM + GRIPPER + "fingers = [{ joint = 'j2' }]\n", "named twice: j2"),
        (ARM + GRIPPER + "fingers = [{ joint = 'a', per_m = 0.0 }]\n", "per_m of a is 0"),
        (ARM + GRIPPER + "fingers = [{ joint = 'a', link_m = 1.0 }]\n", "turns = true"),
        (
            ARM + GRIPPER + "fingers = [{ joint = 'a', turns = true, link_m = 0.05 }]\n",
            "link_m of a is too short",
        ),
        (ARM + GRIPPER + "fingers = [{ jiont = 'a' }]\n", "did you mean 'joint'"),
        (ARM + GRIPPER + "fingers = [{ turns = true }]\n", "missing required field .joint"),
    ],
)
def test_a_wrong_field_is_named(tmp_path: Path, text: str, found: str) -> None:
    with pytest.raises(UsageError, match=found):
        read(tmp_path, text)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_file_has_the_name_by_which_descriptions_find_it(name: str) -> None:
    assert read_robot(name).name == name


@pytest.mark.parametrize("name", [name for name in ROBOTS if name != DEFAULT_ROBOT])
def test_the_record_travels_in_the_description(name: str) -> None:
    robot = read_robot(name)
    carried = robot_of(robot.description())
    assert robot_of(robot.urdf_text()) == robot, "without the record, the file of its name"
    assert (carried.joints, carried.gripper, carried.home_rad) == (
        robot.joints,
        robot.gripper,
        robot.home_rad,
    )
    assert carried.base_frame == robot.base_frame


def test_a_description_without_a_record_is_the_default_robots() -> None:
    assert robot_of('<robot name="unheard_of"/>').name == DEFAULT_ROBOT
    panda, xarm, ur10 = (
        re.sub('<robot name="[^"]*"', '<robot name="mine"', read_robot(name).urdf_text())
        for name in ("panda", "xarm7_parallel_gripper", "ur10_parallel_gripper")
    )
    assert robot_of(panda).name == "panda", "no other file has these joints"
    assert robot_of(xarm).name == "xarm7_parallel_gripper", "no other has so many of these"
    assert robot_of(ur10).name == DEFAULT_ROBOT, "several have these"
    assert robot_of("").name == DEFAULT_ROBOT
    default = read_robot(DEFAULT_ROBOT)
    assert default.description() == default.urdf_text()


@pytest.mark.parametrize("record", ["nothing", "[]", '{"name": "a"}', '{"joints": 3}'])
def test_a_damaged_record_is_refused(record: str) -> None:
    with pytest.raises(UsageError, match=r"carries a record that is not a robot.*--robot"):
        robot_of(f'<robot name="a"><robot_gst>{record}</robot_gst></robot>')


def test_meshes_are_found_beside_the_urdf_and_in_named_folders(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "flange.stl").write_bytes(b"solid")
    named = read(tmp_path, ARM + '[mesh_folders]\nmine = "meshes"\n').urdf_text()
    assert f'filename="{tmp_path}/meshes/flange.stl"' in named
    beside = URDF.replace("package://mine", "meshes")
    assert f'filename="{tmp_path}/meshes/flange.stl"' in read(tmp_path, ARM, beside).urdf_text()
    gone = beside.replace("flange.stl", "gone.stl")
    assert 'filename="meshes/gone.stl"' in read(tmp_path, ARM, gone).urdf_text(), "not needed"
    with pytest.raises(UsageError, match=r"gone\.stl.* is not there"):
        read(tmp_path, ARM, gone.replace("visual", "collision")).urdf_text()


def test_a_tool_that_hangs_on_nothing_is_refused_with_the_links_there_are(tmp_path: Path) -> None:
    (tmp_path / "tool.urdf").write_text(
        '<robot name="t"><link name="tool"/><joint name="m" type="fixed"><parent link="tool0"/>'
        '<child link="tool"/></joint></robot>'
    )
    arm = ARM + 'attached = ["tool.urdf"]\n'
    urdf = URDF.replace("package://mine/flange.stl", "mine.urdf")
    with pytest.raises(UsageError, match=r"hangs on 'tool0'.*Set flange.*base, flange"):
        read(tmp_path, arm, urdf).urdf_text()
    text = read(tmp_path, arm + 'flange = "flange"\n', urdf).urdf_text()
    assert '<parent link="flange" />' in text


@pytest.mark.parametrize(
    "finger",
    [
        Finger(joint="a"),
        Finger(joint="a", turns=True, closed=0.8, per_m=-8.0),
        Finger(joint="a", turns=True, link_m=-0.12, offset_m=0.01, zero_rad=0.2),
    ],
)
def test_the_width_gives_the_joint_and_the_joint_the_width(finger: Finger) -> None:
    widths = np.linspace(0.001, 0.099, 50)
    values = finger.value(widths)
    np.testing.assert_allclose(finger.width(values), widths, atol=1e-12)
    for width, value in zip(widths, values, strict=True):
        assert finger.value(float(width)) == pytest.approx(value, abs=1e-12)
        step = 1e-7
        rise = (finger.value(width + step) - finger.value(width - step)) / (2 * step)
        assert finger.slope(float(width)) == pytest.approx(rise, rel=1e-5)


def test_a_lever_is_two_mirrored_jaws_or_one() -> None:
    """Two jaws of 60 mm that open by the sine of their angle, hinged 10 mm from the middle."""
    finger = Finger(joint="a", turns=True, link_m=2 * 0.06, offset_m=2 * 0.01)
    for angle in (0.0, 0.2, 0.4):
        assert finger.width(angle) == pytest.approx(2 * (0.01 + 0.06 * np.sin(angle)))


def test_held_joints_become_fixed(tmp_path: Path) -> None:
    urdf = URDF.replace("package://mine/flange.stl", "mine.urdf").replace("j1", "extra")
    robot = read(tmp_path, ARM + 'held = ["extra"]\n', urdf)
    assert '<joint name="extra" type="fixed">' in robot.urdf_text()
    assert '<joint name="extra" type="revolute">' in replace(robot, held=()).urdf_text()
