"""The twin as a Gymnasium environment: ``gymnasium.make("robot_gst/Twin-v0", run="runs/x")``.

Importing ``twin.policies.environment`` registers it. Observations and ``info["is_success"]`` are as
LeRobot has them. The same actions from the same start give the same bytes.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, UInt8

from bridge.episode import streams
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from twin.policies.cell import TwinCell
from twin.policies.errors import PolicyError, StoppedError
from twin.policies.mapping import Actions, Interpreter, Kind, PolicyMap
from twin.policies.starts import Start, drawn_starts, open_start, trial_episodes
from twin.policies.views import TwinCameras
from twin.robot.model import RobotModel, load_robot

ID = "robot_gst/Twin-v0"
DELTA_M, DELTA_RAD = 0.05, 0.2
"""Largest step of the tool in one action."""
REACH_M = 2.0
"""Poses of the tool farther from the base are not asked for."""


class TwinEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """One rebuilt cell, seen through its own cameras.

    An action is the arm's target, as ``control`` says, and the distance between the pads [m].
    Rewards are 1 where the task is done, else 0.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # Gymnasium's

    def __init__(
        self,
        run: str | Path,
        task: str = "",
        cameras: Sequence[str] = (),
        size: tuple[int, int] | None = None,
        control: Kind = "joint_position",
        rate_hz: float = 10.0,
        latency_s: float = 0.0,
        max_s: float = 30.0,
        render_mode: str | None = None,
    ) -> None:
        """Open the run, and its scene.

        Args:
            run: Run folder with a rebuilt scene and trials.
            task: Whose starts are used; empty: the first that the run has.
            cameras: Ids of those that are drawn; none: all.
            size: Width and height in which pictures fit; None: as recorded.
            latency_s: An action takes effect so much later; a whole number of steps.
        """
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": rate_hz}
        self._run = RunFolder.open(Path(run))
        episodes = trial_episodes(self._run, task)
        first = episodes[0].info.task
        self._episodes = {e.info.start_id or e.info.id: e for e in episodes if e.info.task == first}
        self._starts: dict[str, Start] = {}
        self._period_s, self._max_ns = 1.0 / rate_hz, round(max_s * 1e9)
        self._late = round(latency_s * rate_hz)
        self._cell: TwinCell | None = None
        start = self._recorded(next(iter(self._episodes)))
        self.task, self.task_description = first, start.task.instruction  # LeRobot asks for them
        self._max_episode_steps = math.ceil(max_s * rate_hz)
        robot = load_robot(start.scene.urdf)
        mapping = PolicyMap(rate_hz=rate_hz, actions=Actions(kind=control))
        self._speak = Interpreter(mapping, robot, start.task.instruction)
        self.cameras = tuple(cameras) or streams.camera_ids(episodes[0])
        sizes = None if size is None else dict.fromkeys(self.cameras, size)
        self._cameras = TwinCameras(self._run, start, self.cameras, sizes)
        low, high = action_limits(control, robot, self._period_s)
        width = robot.record.gripper.max_width_m
        self.action_space = spaces.Box(
            np.append(low, 0.0).astype(np.float32), np.append(high, width).astype(np.float32)
        )
        self.observation_space = spaces.Dict(
            {
                "pixels": spaces.Dict(
                    {
                        name: spaces.Box(0, 255, (p.camera.height, p.camera.width, 3), np.uint8)
                        for name, p in self._cameras.viewpoints.items()
                    }
                ),
                "agent_pos": spaces.Box(-np.inf, np.inf, (len(robot.joints) + 1,), np.float32),
            }
        )

    def _recorded(self, start_id: str) -> Start:
        if start_id not in self._episodes:
            raise UsageError(
                f"no start {start_id!r} in {self._run.path}; there are: {', '.join(self._episodes)}"
            )
        if start_id not in self._starts:
            self._starts[start_id] = open_start(self._run, self._episodes[start_id])
        return self._starts[start_id]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin anew.

        Args:
            seed: Places the objects as the task file draws them.
            options: ``start_id`` of a recorded start instead; neither: the first recorded one.
        """
        super().reset(seed=seed)
        start_id = (options or {}).get("start_id")
        start = self._recorded(start_id or next(iter(self._episodes)))
        if start_id is None and seed is not None:
            start = next(drawn_starts(start, 1, seed))
        if self._cell is not None:
            self._cell.close()
        self._cell = TwinCell(start)
        self._waiting: list[np.ndarray] = []
        return self._observe(), {"start_id": start.id, "is_success": False}

    def step(
        self, action: Float[np.ndarray, " num_values"]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Go on by one period.

        A limit of the robot, or a pose out of reach, ends the episode; ``info["stopped"]`` says
        which.
        """
        cell = self._opened()
        self._waiting.append(np.asarray(action, dtype=np.float64))
        stopped = ""
        try:
            if len(self._waiting) > self._late:
                row = self._waiting.pop(0)
                target = self._speak.target(row, cell.target_rad, cell.target_width_m)
                cell.go(*target, self._period_s)
            else:
                cell.hold(self._period_s)
        except (PolicyError, StoppedError) as error:
            stopped = str(error)
        success = not stopped and cell.succeeds()
        info = {"is_success": success, "stopped": stopped}
        over = bool(stopped) or success or cell.burst
        return self._observe(), float(success), over, cell.t_ns >= self._max_ns, info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """What the first camera sees."""
        self._opened()
        return next(iter(self._pictures.values()), None)

    def close(self) -> None:
        """Free the engine."""
        if self._cell is not None:
            self._cell.close()
            self._cell = None

    def _opened(self) -> TwinCell:
        if self._cell is None:
            raise UsageError("call reset() before step() and render()")
        return self._cell

    def _observe(self) -> dict[str, Any]:
        cell = self._opened()
        self._pictures = self._cameras.draw(cell)
        found = self._speak.observation(self._pictures, *cell.posture())
        return {name: found[name] for name in ("pixels", "agent_pos")}


def action_limits(
    control: Kind, robot: RobotModel, period_s: float
) -> tuple[Float[np.ndarray, " num_values"], Float[np.ndarray, " num_values"]]:
    """Lowest and highest numbers of an action, the gripper's left out."""
    if control == "joint_position":
        return robot.lower_rad, robot.upper_rad
    if control == "ee_delta":
        most = np.array([DELTA_M] * 3 + [DELTA_RAD] * 3)
    elif control == "ee_pose":
        most = np.array([REACH_M] * 3 + [1.0] * 4)
    else:
        share = 1.0 if control == "joint_velocity" else period_s
        most = robot.velocity_limit_rad_s * share
    return -most, most


gymnasium.register(id=ID, entry_point="twin.policies.environment:TwinEnv")
