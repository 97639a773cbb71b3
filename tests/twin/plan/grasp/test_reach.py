"""Which grasps the arm reaches: by its own forward kinematics, and by a pose beyond it."""

import numpy as np
from planned_start import problem_of_test

from twin.plan.grasp.open_hand import open_hand
from twin.plan.grasp.reach import ArmReach, Reached, Reaches
from twin.plan.grasp.search import PREGRASP_M


def test_the_arm_stands_where_it_was_asked_and_a_pose_beyond_it_is_not_reached() -> None:
    problem = problem_of_test()
    wanted = np.array([[1.0, 0, 0, 0.45], [0, -1, 0, 0.2], [0, 0, -1, 0.3], [0, 0, 0, 1]])
    beyond = wanted.copy()
    beyond[0, 3] = 3.0
    hand = open_hand(problem.robot, problem.robot.record.gripper.max_width_m, PREGRASP_M)
    reaches = Reaches(ArmReach(problem), np.stack([wanted, beyond]), hand, PREGRASP_M)
    way = reaches.first(0)
    assert isinstance(way, Reached)
    T = problem.robot.T_base_tcp(way.joints_rad)
    turn = np.array([-1.0, -1.0, 1.0, 1.0]) if way.turned else np.ones(4)
    np.testing.assert_allclose(T, wanted * turn, atol=1e-6)
    assert reaches.first(1) == "reach"
