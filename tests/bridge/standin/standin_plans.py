"""Scripted plans of the stand-in from the arm's home, for the tests of this folder."""

from typing import Any

import numpy as np

from bridge.sources.standin.cell import HOME_SEED_RAD
from bridge.sources.standin.kinematics import arm_kinematics, tool_down
from bridge.sources.standin.planner import NO_ERROR, plan_pick_and_place
from bridge.task.plan import Plan
from bridge.task.task_file import Task


def planned(task: Task, starts: dict[str, np.ndarray], error: Any = NO_ERROR, **more: Any) -> Plan:
    arm = arm_kinematics()
    home = tool_down(np.array([0.42, 0.0, 0.42]), 0.0)
    settings = {
        "kinematics": arm,
        "joints_start_rad": arm.joints_for(home, np.array(HOME_SEED_RAD)),
        "max_joint_speed_rad_s": 1.6,
        "plan_id": "p",
        "condition": "without_replanning",
        "start_id": "s",
    }
    return plan_pick_and_place(task, starts, error, **(settings | more))
