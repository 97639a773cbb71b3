"""Which postures of the arm touch: what the choice between branches of a path asks."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from bridge.task.robot import GRIPPER_LINKS, MAX_WIDTH_M
from twin.replay.clearance.near import own_links
from twin.replay.clearance.surroundings import Surroundings
from twin.replay.config import ReplayConfig
from twin.replay.place.scene import ReplayScene
from twin.robot.collision import RobotHulls


def posture_clearance(
    scene: ReplayScene, hulls: RobotHulls, config: ReplayConfig
) -> Callable[[Float[np.ndarray, "num_postures num_joints"]], Float[np.ndarray, " num_postures"]]:
    """Return a function that says how much room postures leave: negative when links touch.

    The arm against itself and against what stands still, with ``eps_col_m`` taken off. The gripper
    is where the path says, whatever the arm does, so it is left out; so are objects.
    """
    around = Surroundings(scene, hulls, config.eps_col_m)
    links = own_links(hulls)

    def room_m(
        joints_rad: Float[np.ndarray, "num_postures num_joints"],
    ) -> Float[np.ndarray, " num_postures"]:
        return np.array([one(row) for row in joints_rad])

    def one(joints_rad: Float[np.ndarray, " num_joints"]) -> float:
        hulls.place(joints_rad, MAX_WIDTH_M)
        if links.touch():
            return hulls.self_distance().distance_m
        distances, _ = around.measure(
            {},
            [],
            near_m=config.eps_col_m,
            counts=lambda body, other: body not in GRIPPER_LINKS,
        )
        arm = [d for (body, *_), d in distances.items() if body not in GRIPPER_LINKS]
        return min(arm, default=np.inf) - config.eps_col_m

    return room_m
