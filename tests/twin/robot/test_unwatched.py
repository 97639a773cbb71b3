"""What cannot be watched against the rest of the arm is named, and no yes is given."""

import re

from bridge.robots.default import ROBOT
from bridge.robots.robot import read_robot
from twin.robot.collision import RobotHulls
from twin.robot.model import RobotModel

FOREARM = re.compile(r'(<link name="forearm_link">.*?)<collision>.*?</collision>', re.DOTALL)


def test_an_arm_of_which_every_link_has_a_shape_is_watched() -> None:
    assert RobotHulls(RobotModel(ROBOT.urdf_text())).blind() is None


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
