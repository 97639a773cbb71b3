"""The robot that is meant where nobody names another: a UR5 with a parallel gripper of our own.

Nothing of the UR5 is copied into this project: its URDF is read from the installed data package,
and the gripper (``datasets/robots/parallel_gripper.urdf``) is hung on ``tool0``.
"""

from bridge.robots.robot import DEFAULT_ROBOT, read_robot

ROBOT = read_robot(DEFAULT_ROBOT)
ROBOT_NAME = ROBOT.name
BASE_FRAME = ROBOT.base_frame
TCP_FRAME = ROBOT.tool_frame
ARM_JOINTS = ROBOT.joints
FINGER_JOINTS = tuple(finger.joint for finger in ROBOT.gripper.fingers)
FINGER_LINKS = ROBOT.gripper.finger_links
GRIPPER = ROBOT.gripper.name
MAX_WIDTH_M = ROBOT.gripper.max_width_m
