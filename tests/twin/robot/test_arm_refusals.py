"""Robots that cannot be supported or watched are refused by name; what a file sets is used."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import robot_gst
from bridge.data_files import datasets_folder
from bridge.robots.default import ROBOT
from bridge.robots.robot import Robot, read_robot
from twin.robot.check import check_robot
from twin.robot.collision import RobotHulls
from twin.robot.model import RobotDescriptionError, RobotModel, check_dynamics

ROBOTS = sorted(path.stem for path in (datasets_folder() / "robots").glob("*.toml"))
PANDA = read_robot("panda")
UR10E = read_robot("ur10e_parallel_gripper")
TURNS = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
WHEEL = (
    '<link name="wheel"/><joint name="{name}" type="{kind}"><parent link="{parent}"/>'
    f'<child link="wheel"/><axis xyz="0 0 1"/>{TURNS}</joint></robot>'
)


def model(robot: Robot, urdf: str | None = None) -> RobotModel:
    """A robot of a changed record, or of a changed description."""
    return RobotModel(robot.description() if urdf is None else urdf)


@pytest.mark.parametrize(
    ("robot", "found"),
    [
        (replace(PANDA, joints=("elbow", *PANDA.joints[1:])), r"lacks the joints elbow.*--robot"),
        (replace(PANDA, tool_frame="tip"), r"lacks the frame 'tip'"),
        (replace(PANDA, base_frame="floor"), r"lacks the base frame 'floor'.*panda_link0"),
        (replace(PANDA, base_frame="panda_link4"), r"'panda_link4' by 'panda_joint4'"),
        (replace(PANDA, tool_frame="panda_link5"), r"panda_joint6, panda_joint7 on a branch"),
        (replace(PANDA, joints=PANDA.joints[:6]), r"by panda_joint7, which is neither arm nor"),
        (
            replace(PANDA, joints=(*PANDA.joints[1::-1], *PANDA.joints[2:])),
            r"by panda_joint1, panda_joint2.*in another order",
        ),
        (
            replace(PANDA, home_rad=(0.0,) * 7),
            r"'panda_joint4' to -3\.072 to -0\.070 rad, and home_rad puts it at 0\.000",
        ),
        (replace(PANDA, name="mine", gripper=replace(PANDA.gripper, fingers=())), r"finger_joint1"),
    ],
)
def test_a_record_that_does_not_fit_its_urdf_is_refused(robot: Robot, found: str) -> None:
    robot = replace(robot, name="mine", home_rad=robot.home_rad if "home" in found else None)
    robot = replace(robot, acceleration_rad_s2=None, jerk_rad_s3=None)
    with pytest.raises(RobotDescriptionError, match=found):
        model(robot)


@pytest.mark.parametrize(
    ("kind", "found"),
    [
        ("revolute", r"moves by spin, which is neither arm nor finger.*held"),
        ("continuous", r"moves by spin"),
        ("floating", r"'spin' of the type 'floating'.*fixed base"),
        ("planar", r"'spin' of the type 'planar'"),
    ],
)
def test_a_branch_that_moves_is_refused_unless_it_is_held(kind: str, found: str) -> None:
    more = WHEEL.format(name="spin", kind=kind, parent="panda_link3")
    urdf = PANDA.urdf_text().replace("</robot>", more)
    with pytest.raises(RobotDescriptionError, match=found):
        model(PANDA, urdf)


@pytest.mark.parametrize(
    ("pattern", "changed", "found"),
    [
        (r'(<link name="panda_link4">.*?)<inertial>.*?</inertial>', r"\1", r"'panda_joint4' moves"),
        (r'(name="panda_link2".*?<mass value=")[^"]*', r"\g<1>0", r"'panda_joint2' moves"),
        (r'(name="panda_joint5".*?effort=")[^"]*', r"\g<1>0", r"'panda_joint5' no effort"),
    ],
)
def test_what_cannot_be_simulated_is_refused_by_its_joint(
    pattern: str, changed: str, found: str
) -> None:
    """Kinematics needs neither masses nor motors."""
    before = PANDA.urdf_text()
    urdf = re.sub(pattern, changed, before, count=1, flags=re.DOTALL)
    assert urdf != before
    robot = model(PANDA, urdf)
    with pytest.raises(RobotDescriptionError, match=found):
        check_dynamics(robot)
    check_dynamics(model(PANDA))


def test_limits_of_the_record_go_before_those_of_the_urdf() -> None:
    ranges = tuple((-1.0 - k / 10, 2.0) for k in range(7))
    speeds = tuple(0.1 + k / 10 for k in range(7))
    limited = model(
        replace(PANDA, name="mine", position_rad=ranges, velocity_rad_s=speeds, home_rad=None)
    )
    np.testing.assert_allclose(limited.lower_rad, [low for low, _ in ranges])
    np.testing.assert_allclose(limited.upper_rad, 2.0)
    np.testing.assert_allclose(limited.velocity_limit_rad_s, speeds)
    np.testing.assert_allclose(limited.home_rad, (limited.lower_rad + limited.upper_rad) / 2)


def dh_pose(theta: np.ndarray) -> np.ndarray:
    """The UR10e of the published Denavit-Hartenberg table, in the controller's base."""
    d = (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
    a = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)
    alpha = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
    T = np.eye(4)
    for row in zip(theta, d, a, alpha, strict=True):
        (c, s), (ca, sa) = ((np.cos(row[k]), np.sin(row[k])) for k in (0, 3))
        T = T @ [
            [c, -s * ca, s * sa, row[2] * c],
            [s, c * ca, -c * sa, row[2] * s],
            [0.0, sa, ca, row[1]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    return T


@pytest.mark.parity
def test_our_ur10e_is_the_published_one() -> None:
    robot, rng = model(UR10E), np.random.default_rng(0)
    T_controller_base = np.linalg.inv(robot.T_base_link("base", robot.home_rad))
    for theta in rng.uniform(-np.pi, np.pi, (50, 6)):
        flange = T_controller_base @ robot.T_base_link("tool0", theta)
        np.testing.assert_allclose(flange, dh_pose(theta), atol=1e-9)
    masses = [robot.model.inertias[robot.model.getJointId(name)].mass for name in robot.joints[:5]]
    np.testing.assert_allclose(masses, [7.369, 13.051, 3.989, 2.1, 1.98])


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_that_ship_pass_their_check(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out" / "mine.urdf"
    found = check_robot(name, urdf_out=out)
    assert found["reached"].startswith("20 of 20")
    assert out.read_text() == read_robot(name).description()
    assert not [text for text in found["limits"] if "touch" in text or "lacks" in text]


def test_the_check_command_ends_with_2_and_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert robot_gst.run(["robot", "check", "z1"]) == 0
    assert "jointGripper: 0 m at" in capsys.readouterr().out
    text = (datasets_folder() / "robots" / "panda.toml").read_text()
    path = tmp_path / "mine.toml"
    for changed, found in (
        (text.replace("panda_joint4", "panda_elbow"), "panda_elbow"),
        (text.replace("panda.urdf", "gone.urdf"), "gone.urdf"),
        (text.replace("max_width_m = 0.08", ""), "max_width_m"),
        (text.replace("base_frame", "base_farme"), "did you mean 'base_frame'"),
    ):
        path.write_text(changed)
        assert robot_gst.run(["robot", "check", str(path)]) == 2
        assert found in capsys.readouterr().err


def test_links_said_to_overlap_are_not_watched() -> None:
    pair = ("panda_link5", "panda_link7")

    def watched(robot: Robot) -> set[frozenset[str]]:
        hulls = RobotHulls(model(robot))
        return {frozenset((hulls.hulls[a].link, hulls.hulls[b].link)) for a, b in hulls.pairs}

    assert frozenset(pair) in watched(PANDA)
    assert frozenset(pair) not in watched(replace(PANDA, name="mine", may_overlap=(pair,)))


FOREARM = re.compile(r'(<link name="forearm_link">.*?)<collision>.*?</collision>', re.DOTALL)


def test_a_link_that_can_be_seen_and_has_no_shape_is_named() -> None:
    text, count = FOREARM.subn(r"\1", ROBOT.urdf_text())
    assert count == 1
    found = RobotHulls(RobotModel(text)).blind()
    assert found == "the links forearm_link have no collision shapes: nobody watches them"


def test_pairs_that_are_left_out_are_told_and_too_many_are_no_yes() -> None:
    hulls = RobotHulls(RobotModel(read_robot("ur10e_parallel_gripper").description()))
    assert hulls.left_out == {"base_link and upper_arm_link": "they touch at home"}
    assert hulls.blind() is None
    hulls.share_left_out = 0.21
    assert "21% of the pairs" in str(hulls.blind())
