"""The start that the planner's tests plan from."""

from dataclasses import replace

import numpy as np
from scripted_plans import scene_of_test

from twin.plan.problem import Problem
from twin.plan.shapes import shapes_of
from twin.replay.scene import ReplayScene
from twin.robot.model import load_robot

HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])


def problem_of_test(scene: ReplayScene | None = None) -> Problem:
    scene = scene_of_test() if scene is None else scene
    return Problem(
        scene=replace(scene, start_rad=HOME),
        robot=load_robot(scene.urdf),
        shapes=shapes_of(None, scene.task),
    )
