"""Robot files proposed from a URDF alone, beside those that people wrote of the same arms."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from bridge.errors import PathNotFoundError, UsageError
from bridge.robots.robot import Robot, read_robot, resolve_mesh
from bridge.terminal import Output
from dashboards.opening import look_at
from dashboards.robot_file import propose, write_robot_file
from twin.robot.check import check_robot

BY_HAND = ("panda", "z1", "kinova_j2s6s200", "xarm7_parallel_gripper", "so100", "so101")
URS = ("ur3_parallel_gripper", "ur5_parallel_gripper", "ur10_parallel_gripper")


def link(name: str) -> str:
    shape = '<collision><geometry><box size="0.02 0.02 0.02"/></geometry></collision>'
    return f'<link name="{name}">{shape}</link>'


def joint(name: str, kind: str, parent: str, child: str, more: str = "") -> str:
    limit = '<limit lower="-2" upper="2" velocity="1" effort="9"/>' if kind == "revolute" else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 0.1"/><axis xyz="0 {len(name) % 2} {1 - len(name) % 2}"/>'
        f"{limit}{more}</joint>"
    )


def chain(side: str, count: int, root: str) -> str:
    names = [root, *(f"{side}_{index}" for index in range(count))]
    joints = [joint(f"{side}_j{i}", "revolute", names[i], names[i + 1]) for i in range(count)]
    return "".join([*map(link, names[1:]), *joints])


JAW = '<limit lower="0" upper="0.03" velocity="1" effort="9"/>'


def jaws(hand: str, first: str = "jaw_a", second: str = "jaw_b", more: str = "") -> str:
    return (
        link("jaw_a")
        + link("jaw_b")
        + joint(first, "prismatic", hand, "jaw_a", JAW)
        + joint(second, "prismatic", hand, "jaw_b", JAW + more)
    )


def written(folder: Path, inside: str, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.write_text(f'<robot name="mine">{link("base")}{inside}</robot>')
    return path


@pytest.mark.parametrize("name", BY_HAND + URS)
def test_the_arm_is_the_one_that_people_named(name: str) -> None:
    """A robot file by hand names the same joints, and a base that does not move against ours."""
    by_hand = read_robot(name)
    proposed, _ = propose(resolve_mesh(by_hand.urdf))
    assert proposed.joints == by_hand.joints
    model = pin.buildModelFromXML(proposed.urdf_text())
    ours, theirs = (
        model.frames[model.getFrameId(n)] for n in (proposed.base_frame, by_hand.base_frame)
    )
    assert ours.parentJoint == theirs.parentJoint == 0


def test_the_hand_of_the_panda_opens_as_its_file_says() -> None:
    """Two jaws of 40 mm, the second one a mimic."""
    by_hand = read_robot("panda").gripper
    ours = propose(resolve_mesh(read_robot("panda").urdf))[0].gripper
    assert (ours.finger_links, ours.max_width_m) == (by_hand.finger_links, by_hand.max_width_m)
    assert set(ours.links) == set(by_hand.links)
    for width_m in (0.0, 0.03, 0.08):
        assert ours.fingers[0].value(width_m) == by_hand.fingers[0].value(width_m)
    assert [f.joint for f in ours.fingers] == [f.joint for f in by_hand.fingers]


def test_of_two_arms_on_one_trunk_one_is_proposed_and_all_else_held(tmp_path: Path) -> None:
    """The trunk moves the other arm too, so it is no part of this one."""
    trunk = link("trunk") + joint("waist", "revolute", "base", "trunk")
    body = trunk + chain("left_arm", 6, "trunk") + chain("right_arm", 6, "trunk")
    robot, notes = propose(written(tmp_path, body + chain("leg", 7, "base")))
    assert robot.joints == tuple(f"left_arm_j{i}" for i in range(6))
    right, leg = [f"right_arm_j{i}" for i in range(6)], [f"leg_j{i}" for i in range(7)]
    assert set(robot.held) == {"waist", *right, *leg}
    assert robot.base_frame == "base"
    assert any("right_arm_j5" in note and "leg_j6" in note for note in notes)


@pytest.mark.parametrize("mimic", [False, True])
def test_jaws_that_slide_open_by_the_sum_of_their_ways(tmp_path: Path, mimic: bool) -> None:
    more = '<mimic joint="jaw_a"/>' if mimic else ""
    robot, _ = propose(written(tmp_path, chain("arm", 6, "base") + jaws("arm_5", more=more)))
    gripper = robot.gripper
    assert gripper.max_width_m == pytest.approx(0.06)
    assert len(gripper.fingers) == 2 - mimic
    for finger in gripper.fingers:
        assert [finger.value(w) for w in (0.0, 0.06)] == pytest.approx([0.0, 0.03])
    assert robot.held == ()


def test_a_horn_that_spins_beside_the_jaws_is_held(tmp_path: Path) -> None:
    horn = joint("gripper", "continuous", "arm_5", "horn") + link("horn")
    robot, _ = propose(written(tmp_path, chain("arm", 6, "base") + horn + jaws("arm_5")))
    assert [finger.joint for finger in robot.gripper.fingers] == ["jaw_a", "jaw_b"]
    assert (len(robot.joints), robot.held) == (6, ("gripper",))


def test_a_hand_whose_width_nobody_gives_is_held_and_said_to_be(tmp_path: Path) -> None:
    turning = joint("finger_joint", "revolute", "arm_5", "finger") + link("finger")
    robot, notes = propose(written(tmp_path, chain("arm", 6, "base") + turning))
    assert (robot.gripper.fingers, robot.held) == ((), ("finger_joint",))
    assert len(robot.joints) == 6
    assert any("finger_joint" in note for note in notes)


def test_a_tool_frame_does_not_move_with_a_finger(tmp_path: Path) -> None:
    tip = link("tool_tip") + joint("tip", "fixed", "jaw_a", "tool_tip")
    mount = link("tcp") + joint("mount", "fixed", "arm_5", "tcp")
    inside = chain("arm", 6, "base") + jaws("arm_5") + tip + mount
    assert propose(written(tmp_path, inside))[0].tool_frame == "tcp"


@pytest.mark.parametrize("package", ["my_arm", "my_arm_description"])
def test_meshes_of_the_package_that_the_file_lies_in_are_found(
    tmp_path: Path, package: str
) -> None:
    """Also where somebody named the package's folder anew."""
    meshes = tmp_path / "my_arm" / "meshes"
    meshes.mkdir(parents=True)
    corners = np.vstack([np.zeros(3), np.eye(3)])
    faces = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in 0.1 * np.delete(corners, i, axis=0))
        + "endloop\nendfacet\n"
        for i in range(4)
    )
    (meshes / "part.stl").write_text(f"solid part\n{faces}endsolid part\n")
    (tmp_path / "my_arm" / "urdf").mkdir()
    mesh = f"package://{package}/meshes/part.stl"
    shape = f'<geometry><mesh filename="{mesh}"/></geometry>'
    text = chain("arm", 6, "base").replace("<collision>", f"<visual>{shape}</visual><collision>")
    path = written(tmp_path / "my_arm" / "urdf", text)
    assert str(meshes / "part.stl") in propose(path)[0].description()


def read_back(urdf: Path, path: Path) -> tuple[Robot, Robot]:
    write_robot_file(urdf, path, output=Output(quiet=True))
    return read_robot(str(path)), propose(urdf)[0]


@pytest.mark.parametrize("name", ["panda", "z1"])
def test_what_is_written_is_the_proposal(tmp_path: Path, name: str) -> None:
    urdf = resolve_mesh(read_robot(name).urdf)
    kept, proposed = read_back(urdf, tmp_path / "new" / "mine.toml")
    assert kept == replace(proposed, folder=kept.folder, urdf=kept.urdf)
    assert kept.urdf_text() == proposed.urdf_text()


def test_a_description_is_checked_as_its_file_would_be(tmp_path: Path) -> None:
    urdf = written(tmp_path, chain("arm", 6, "base") + jaws("arm_5"))
    read_back(urdf, tmp_path / "mine.toml")
    assert check_robot(str(urdf)) == check_robot(str(tmp_path / "mine.toml"))


@pytest.mark.parametrize(
    ("inside", "name", "told"),
    [
        (
            chain("leg", 4, "base"),
            "robot.urdf",
            "longest chain has 4: leg_j0, leg_j1, leg_j2, leg_j3",
        ),
        ("", "robot.urdf", "longest chain has 0: none"),
        ("<xacro:arm/>", "robot.xacro", "expand it first"),
        ("<link", "robot.urdf", "is not XML"),
    ],
)
def test_what_holds_no_arm_is_refused_with_what_there_is(
    tmp_path: Path, inside: str, name: str, told: str
) -> None:
    with pytest.raises(UsageError, match=told):
        look_at(written(tmp_path, inside, name))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "iso-8859-1", "utf-16"])
def test_an_encoding_that_the_file_declares_is_read(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "robot.urdf"
    text = f'<robot name="m">{link("base")}{chain("ärm", 6, "base")}</robot>'
    path.write_bytes(
        f'<?xml version="1.0" encoding="{encoding}"?>{text}'.replace("-sig", "").encode(encoding)
    )
    assert propose(path)[0].joints == tuple(f"ärm_j{i}" for i in range(6))


def test_a_linear_axis_is_held_and_a_crowd_of_joints_refused(tmp_path: Path) -> None:
    limit = '<limit lower="0" upper="3" velocity="1" effort="9"/>'
    axis = link("sled") + joint("axis", "prismatic", "base", "sled", limit)
    robot, _ = propose(written(tmp_path, axis + chain("arm", 6, "sled")))
    assert (robot.held, len(robot.joints)) == (("axis",), 6)
    with pytest.raises(UsageError, match="has 1500 joints"):
        propose(written(tmp_path, chain("arm", 1500, "base")))
    with pytest.raises(PathNotFoundError):
        propose(tmp_path / "none.urdf")


def test_what_only_simulators_read_is_passed_over(tmp_path: Path) -> None:
    sensor = '<gazebo reference="base"/><gazebo><sensor:camera name="c"/></gazebo>'
    path = written(tmp_path, sensor + chain("arm", 6, "base"))
    assert len(propose(path)[0].joints) == 6
    assert "camera" not in propose(path)[0].description()
    path.write_text(path.read_text().replace("</gazebo>", "</gazebo>\n<broken"))
    with pytest.raises(UsageError, match="line 2"):
        propose(path)


def test_no_file_is_overwritten_and_only_robot_files_are_made(tmp_path: Path) -> None:
    urdf = written(tmp_path, chain("arm", 6, "base"))
    (tmp_path / "mine.toml").write_text("mine")
    for path, told in (
        (tmp_path / "mine.toml", "is there already"),
        (tmp_path / "run", "ends with .toml"),
    ):
        with pytest.raises(UsageError, match=re.escape(told)):
            write_robot_file(urdf, path, output=Output(quiet=True))
    assert (tmp_path / "mine.toml").read_text() == "mine"
    assert not (tmp_path / "run").exists()
