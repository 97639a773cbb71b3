"""A pick and place sent to the stand-in cell joint by joint: nobody plans, and no event says when.

``python tests/end_to_end/joint_by_joint.py ENDPOINT TRIALS`` moves the cell of a running recorder
as a person at a teach pendant would: to a posture, close the fingers, to the next. Every other
trial grasps beside the cube.
"""

import sys
from collections.abc import Mapping

import numpy as np

from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.robots.default import MAX_WIDTH_M
from bridge.sources.standin import operator, session
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.cli import publish_standin
from bridge.sources.standin.kinematics import tool_down
from bridge.sources.standin.scan import joint_move
from bridge.sources.standin.settings import SessionConfig

OVER_M, GRASP_M, RELEASE_M = 0.15, 0.02, 0.1
"""Heights of the tool above the table."""
BESIDE_M = 0.06


def move_by_hand(cell: StandinCell, poses: Mapping[str, np.ndarray], beside_m: float) -> None:
    """Carry the cube into the box, posture by posture, as a person at a pendant would."""
    cube, box = (poses[name] for name in ("cube", "box"))
    yaw = float(np.arctan2(cube[1, 0], cube[0, 0]))
    at = cell.home_rad
    for T, heights in ((cube, (OVER_M, GRASP_M)), (box, (OVER_M, RELEASE_M))):
        for height_m in (*heights, OVER_M):
            p = np.array([T[0, 3] + (beside_m if T is cube else 0.0), T[1, 3], height_m])
            target = cell.kinematics.joints_for(tool_down(p, yaw if T is cube else 0.0), at)
            cell.follow(*joint_move(at, target, cell.file.max_joint_speed_rad_s / 2))
            at = target
            if height_m != OVER_M:
                cell.grip(0.0 if T is cube else MAX_WIDTH_M)
                cell.wait(0.8)


class Pendant(operator.Operator):
    """Moves the arm from posture to posture."""

    def _attempt(self, info: EpisodeInfo, treatment: operator.Treatment, seed: int) -> Outcome:
        cell = self._cell
        poses = self.start_poses(info.start_seed or 0, treatment.name)
        cell.reset(poses)
        self._begin(info)
        cell.cameras_running = True
        rest_s = operator.wait_s(operator.LOOK_S, cell.rate_hz)
        cell.wait(rest_s)
        move_by_hand(cell, poses, BESIDE_M * ((info.trial or 0) % 2 == 0))
        cell.wait(operator.wait_s(operator.SETTLE_S, cell.rate_hz))
        outcome = operator.label_trial(cell.world.task, cell.truth, executed=False)
        cell.cameras_running = False
        self._end(outcome)
        return outcome


def main(endpoint: str, trials: int) -> int:
    """Record a scan and some trials; returns the command's exit code."""
    session.Operator = Pendant  # type: ignore[misc]
    config = SessionConfig(
        task="cube_into_box", trials=trials, conditions=("without_replanning",), seed=7
    )
    return publish_standin(config=config, connect=(endpoint,))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
