"""What ``robot check`` says of a description that somebody else wrote: every link and joint."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import robot_gst
from bridge.errors import UsageError
from dashboards.robot_file import propose
from twin.robot.check import check_robot
from twin.robot.collision import convex_hull, link_hulls
from twin.robot.model import RobotModel

RECORD = """schema_version = 1
name = "plain"
urdf = "arm.urdf"
base_frame = "l0"
tool_frame = "l6"
joints = ["j1", "j2", "j3", "j4", "j5", "j6"]
"""
SHAPE = '<cylinder length="0.1" radius="0.03"/>'
LINK = (
    '<link name="l{0}"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" '
    'ixy="0" ixz="0" iyz="0"/></inertial><visual><geometry><sphere radius="0.05"/></geometry>'
    f"</visual><collision><geometry>{SHAPE}</geometry></collision></link>"
)
JOINT = (
    '<joint name="j{0}" type="revolute"><parent link="l{1}"/><child link="l{0}"/>'
    '<origin xyz="0 0 0.2"/><axis xyz="{2}"/><limit lower="-3" upper="3" velocity="2" '
    'effort="50"/></joint>'
)
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
URDF = (
    '<robot name="arm">'
    + "".join(LINK.format(index) for index in range(7))
    + "".join(JOINT.format(index + 1, index, axis) for index, axis in enumerate(AXES))
    + "</robot>"
)


def written(folder: Path, urdf: str, record: str = RECORD) -> str:
    (folder / "arm.urdf").write_text(urdf)
    (folder / "arm.toml").write_text(record)
    return str(folder / "arm.toml")


def of_link(index: int, old: str, new: str) -> str:
    """The description with one link changed."""
    before, name, after = URDF.partition(f'<link name="l{index}">')
    assert old in after
    return before + name + after.replace(old, new, 1)


@pytest.mark.parametrize(
    ("urdf", "level", "found"),
    [
        (of_link(3, SHAPE, "<plane/>"), "gate", "the link 'l3' is not watched: 0 of its 1"),
        (
            of_link(5, "<collision>", "<drawn>").replace(
                '</collision></link><link name="l6', '</drawn></link><link name="l6'
            ),
            "gate",
            "the link 'l5' is not watched: 0 of its 0",
        ),
        (
            of_link(2, "</collision>", "</collision><collision><geometry/></collision>"),
            "gate",
            "the link 'l2' is not watched: 0 of its 2",
        ),
        (of_link(4, SHAPE, '<box size="200 10 10"/>'), "gate", "'l4' is 200 m long; is it in mill"),
        (
            URDF.replace('xyz="0 0 0.2"', 'xyz="0 0 200"'),
            "gate",
            "1200 m apart; are their origins in mill",
        ),
        (of_link(2, 'ixx="0.01"', 'ixx="0.03"'), "dynamic", "the inertia of the link 'l2' is no"),
        (of_link(6, 'value="1"', 'value="0"'), "dynamic", "no inertia to what 'j6' moves: l6"),
        (URDF.replace('effort="50"', 'effort="0"', 1), "dynamic", "the joint 'j1' no effort"),
        (
            URDF.replace('velocity="2"', 'velocity="0"', 1),
            "gate",
            "the joint 'j1' has a speed of 0",
        ),
        (
            URDF.replace('lower="-3" upper="3"', 'lower="-170" upper="170"', 1),
            "kinematic",
            "the joint 'j1' is limited to -170 to 170 rad; are these degrees?",
        ),
    ],
)
def test_what_a_description_lacks_is_named_with_its_level(
    tmp_path: Path, urdf: str, level: str, found: str
) -> None:
    assert check_robot(written(tmp_path, URDF))["findings"] == []
    findings = check_robot(written(tmp_path, urdf))["findings"]
    assert [item["level"] for item in findings] == [level]
    assert found in findings[0]["found"]


@pytest.mark.parametrize(
    ("urdf", "found"),
    [
        (
            of_link(1, SHAPE, '<box size="0 0 0"/>').replace("0 1 0", "0 0 0"),
            "the joint 'j2' with an axis of length 0; the joint 'j3' .*; the joint 'j5' .*; "
            "the link 'l1' with a box of size 0 0 0",
        ),
        (of_link(0, SHAPE, '<sphere radius="-1"/>'), "the link 'l0' with a sphere of size -1"),
        (of_link(0, SHAPE, '<box size="1 x 1"/>'), "the link 'l0' with a box of size 1 nan 1"),
        (URDF.replace(SHAPE, ""), "gives no link a collision shape"),
        (
            URDF.replace('name="j1" type="revolute"', 'name="jx" type="revolute"')
            .replace('ixx="0.01"', "", 1)
            .replace('lower="-3" upper="3" velocity="2"', 'lower="-90" upper="90" velocity="0"'),
            r"lacks the joints j1.*\n  kinematic: .*'j2' is limited to -90 .*\n(.*\n)*"
            r"  gate: the joint 'j6' has a speed of 0.*\n  dynamic: the inertia of the link 'l0'",
        ),
        (
            URDF.replace("<link", '<xacro:property name="a" value="1"/><link', 1),
            "is a xacro file; expand it first: xacro .*arm.urdf",
        ),
    ],
)
def test_what_no_engine_takes_is_refused_with_every_name(
    tmp_path: Path, urdf: str, found: str
) -> None:
    with pytest.raises(UsageError, match=found):
        check_robot(written(tmp_path, urdf))


def test_links_without_their_meshes_hinder_the_gate_and_no_motion(tmp_path: Path) -> None:
    rail = (
        '<link name="floor"/><joint name="rail" type="prismatic"><parent link="floor"/>'
        '<child link="l0"/><axis xyz="1 0 0"/><limit lower="0" upper="2" velocity="1" effort="9"/>'
        "</joint></robot>"
    )
    urdf = of_link(3, SHAPE, '<mesh filename="package://own/a.stl"/>').replace("</robot>", rail)
    record = RECORD.replace('"l0"', '"floor"') + 'held = ["rail"]\n'
    name = written(tmp_path, urdf.replace(SHAPE, '<mesh filename="b.stl"/>', 1), record)
    found, whole = check_robot(name), check_robot(written(tmp_path, URDF))
    assert [item["level"] for item in found["findings"]] == ["gate", "gate"]
    first, second = (item["found"] for item in found["findings"])
    assert first.startswith(f"the link 'l0': '{tmp_path}/b.stl' is not there")
    assert second.startswith("the link 'l3': mesh 'package://own/a.stl' is in package 'own'")
    assert (found["hulls"], found["reached"]) == (None, whole["reached"])
    assert "held at 0: rail" in found["limits"]
    (tmp_path / "arm.urdf").write_text(urdf)
    assert robot_gst.run(["robot", "check", str(tmp_path / "arm.urdf")]) == 2
    notes = propose(tmp_path / "arm.urdf")[1]
    assert "rail moves the arm and is held at 0" in notes
    assert [note.partition(":")[0] for note in notes if "mesh" in note] == ["the link 'l3'"]


@pytest.mark.parametrize("how", ["capsule", "capsule of pinocchio", "sphere", "cone"])
def test_a_shape_lies_inside_its_hull(tmp_path: Path, how: str) -> None:
    check_robot(written(tmp_path, URDF), urdf_out=tmp_path / "described.urdf")
    text = (tmp_path / "described.urdf").read_text()
    if how.startswith("cone"):
        turns = np.linspace(0, 2 * np.pi, 300, endpoint=False)
        ring = 0.05 * np.stack([np.cos(turns), np.sin(turns), np.zeros(300)], axis=1)
        inside = np.vstack([ring, [[0, 0, 0.1]]])
        points, most_m = np.array(convex_hull(inside).points()), 0.102
    else:
        checking = 'name="l0"><collision_checking><capsule name="l0"/></collision_checking>'
        named = text.replace('name="l0">', checking, 1).replace(
            "<collision>", '<collision name="l0">', 1
        )
        shape = text.replace("<cylinder", f"<{how}", 1) if " " not in how else named
        points = link_hulls(RobotModel(shape))[0].points_m
        ball = np.random.default_rng(0).normal(size=(500, 3))
        ball *= 0.03 / np.linalg.norm(ball, axis=1, keepdims=True)
        end = np.array([0, 0, 0.0 if how == "sphere" else 0.05])
        inside, most_m = np.concatenate([ball + end, ball - end]), 0.081
    faces = ConvexHull(points).equations
    assert (inside @ faces[:, :3].T + faces[:, 3]).max() <= 1e-6
    assert np.abs(points[:, 2]).max() < most_m


def test_a_robot_file_is_found_from_wherever_it_is_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = [(0.0, 0.0, 0.0), (50.0, 0.0, 0.0), (0.0, 50.0, 0.0), (0.0, 0.0, 50.0)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    facets = [
        "facet normal 0 0 0 outer loop "
        + " ".join(f"vertex {x:g} {y:g} {z:g}" for x, y, z in (ends[i] for i in face))
        + " endloop endfacet"
        for face in faces
    ]
    (tmp_path / "corner.stl").write_text("\n".join(["solid corner", *facets, "endsolid corner"]))
    mesh = '<mesh filename="corner.stl" scale="0.001 0.001 0.001"/>'
    written(tmp_path, URDF.replace(SHAPE, mesh))
    monkeypatch.chdir(tmp_path)
    assert check_robot("arm.toml")["hulls"] == 7
    monkeypatch.chdir(tmp_path.parent)
    assert check_robot(str(Path(tmp_path.name, "arm.toml")))["hulls"] == 7


def test_what_follows_a_held_joint_is_held_with_it(tmp_path: Path) -> None:
    finger = (
        '<link name="f{0}"/><joint name="g{0}" type="prismatic"><parent link="l6"/><child '
        'link="f{0}"/><axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="1" effort="9"/>'
        "{1}</joint></robot>"
    )
    urdf = URDF.replace("</robot>", finger.format(1, ""))
    urdf = urdf.replace("</robot>", finger.format(2, '<mimic joint="g1"/>'))
    found = check_robot(written(tmp_path, urdf, RECORD + 'held = ["g1"]\n'))
    assert len(found["joints"]) == 6
    moved = urdf.replace('<mimic joint="g1"/>', '<mimic joint="g1" offset="0.01"/>')
    with pytest.raises(UsageError, match=r"'g2' mimic 'g1', and 'g1' is fixed.*list both as held"):
        check_robot(written(tmp_path, moved, RECORD + 'held = ["g1"]\n'))
