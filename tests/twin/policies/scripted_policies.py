"""Policies for tests: one that does the task, and some that do not."""

from typing import Any

import numpy as np
from scripted_plans import pick_and_place, scene_of_test, with_joints

from twin.replay.path import path_of_plan
from twin.robot.model import load_robot


class Scripted:
    """Picks the cube and puts it into the box, in chunks of ten rows; it sees nothing."""

    seeds: list[int] = []  # noqa: RUF012  # of all of them
    metadata = {"name": "scripted"}  # noqa: RUF012

    def __init__(self) -> None:
        """Solve the plan once."""
        scene = scene_of_test()
        plan = with_joints(pick_and_place(scene, pace=1.5), scene)
        self.path, _, _ = path_of_plan(plan, load_robot(scene.urdf))
        self.t_ns = 0

    def reset(self, seed: int) -> None:
        self.t_ns = 0
        Scripted.seeds.append(seed)

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        if set(observation["pixels"]) != {"side", "wrist"}:
            raise ValueError("two cameras were expected")
        times = self.t_ns + 100_000_000 * (1 + np.arange(10))
        self.t_ns = int(times[-1])
        joints, widths = self.path.joints_at(times), self.path.width_at(times - 100_000_000)
        return {"actions": np.column_stack([joints, widths])}


def still(observation: dict[str, Any]) -> np.ndarray:
    return np.asarray(observation["agent_pos"])


def brightness(observation: dict[str, Any]) -> np.ndarray:
    """Goes by the mean of its pictures: black 0 rad, white 1 rad."""
    found = np.array(observation["agent_pos"])
    found[:6] = np.mean([picture.mean() / 255 for picture in observation["pixels"].values()])
    return found


def reckless(observation: dict[str, Any]) -> np.ndarray:
    return np.asarray(observation["agent_pos"]) + 1.0


def raising(observation: dict[str, Any]) -> np.ndarray:
    raise KeyError("wrist")


def nodding(observation: dict[str, Any], joint: int = 0) -> np.ndarray:
    """Turns the whole arm slowly."""
    rows = np.repeat(np.array(observation["agent_pos"], dtype=np.float64)[None], 10, axis=0)
    rows[:, joint] += 0.03 * np.arange(1, 11)
    return rows


def pressing(observation: dict[str, Any]) -> np.ndarray:
    """Brings the arm down, through the table."""
    return nodding(observation, joint=1)


def nodding_until_it_turned(observation: dict[str, Any]) -> Any:
    """Is done once its arm stands 0.1 rad from where arms start."""
    return {"done": True} if observation["agent_pos"][0] > 0.1 else nodding(observation)
