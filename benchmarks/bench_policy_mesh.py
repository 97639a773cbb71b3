"""Policies that see plain shapes, splats or the cell, from the same starts: docs/policies.md.

Usage: python benchmarks/bench_policy_mesh.py RUN MAP NAME=module:function ...: a run with a trial
of each of these policies from each start, and their rollouts; it is copied, and each policy is
rolled out once more while PyBullet draws the robot's meshes, the task file's boxes in their
colours and a table of one colour. Protocol, written before the first trial: seed 90417, the ten
policies and three tasks of the study, starts that all ten have tried; success by the task file.
"""

import sys
import tempfile
from pathlib import Path
from shutil import copytree, ignore_patterns
from typing import Any

import numpy as np
import pandas as pd
import pybullet
from measure import Target, report_targets

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.terminal import Output
from evaluator.statistics.agreement import mmrv, pearson
from twin.policies import runs, views
from twin.policies.cell import Sight
from twin.policies.config import RolloutConfig
from twin.policies.starts import Start
from twin.robot.model import RobotModel, load_robot, with_absolute_meshes

WOOD, GREY = [0.76, 0.60, 0.42, 1.0], 150
TABLE_M, NEAR_M, FAR_M = (0.8, 0.8, 0.005), 0.02, 5.0
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Shapes:
    """What stands in one cell, in a PyBullet that is never stepped."""

    def __init__(self, start: Start) -> None:
        """Load the robot, the table and the task's boxes."""
        self.id, self.robot = pybullet.connect(pybullet.DIRECT), load_robot(start.scene.urdf)
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
            file.write(with_absolute_meshes(start.scene.urdf))
            file.flush()
            self.arm = pybullet.loadURDF(file.name, useFixedBase=True, physicsClientId=self.id)
        numbers = range(pybullet.getNumJoints(self.arm, self.id))
        names = {pybullet.getJointInfo(self.arm, k, self.id)[1].decode(): k for k in numbers}
        model = self.robot.model
        self.joints = {
            k: model.joints[model.getJointId(name)].idx_q
            for name, k in names.items()
            if model.existJointName(name)
        }
        self._boxes([(np.array([0.4, 0.0, -TABLE_M[2]]), 2 * np.array(TABLE_M))], WOOD)
        self.bodies = {
            name: self._boxes(each.panels(), [*(np.array(each.color_srgb) / 255), 1.0])
            for name, each in start.task.objects.items()
        }

    def _boxes(self, panels: list[tuple[np.ndarray, np.ndarray]], color: list[float]) -> int:
        shape = pybullet.createVisualShapeArray(
            [pybullet.GEOM_BOX] * len(panels),
            halfExtents=[(size / 2).tolist() for _, size in panels],
            visualFramePositions=[centre.tolist() for centre, _ in panels],
            rgbaColors=[color] * len(panels),
            physicsClientId=self.id,
        )
        return int(pybullet.createMultiBody(0, -1, shape, physicsClientId=self.id))

    def picture(self, place: views.Viewpoint, sight: Sight) -> np.ndarray:
        """What a camera sees."""
        q = self.robot.configuration(sight.joints_rad, sight.width_m)
        for k, row in self.joints.items():
            pybullet.resetJointState(self.arm, k, float(q[row]), physicsClientId=self.id)
        for name, T in sight.places.items():
            w, x, y, z = se3.quaternion_from_rotation(T[:3, :3])
            where = T[:3, 3].tolist(), [x, y, z, w]
            pybullet.resetBasePositionAndOrientation(self.bodies[name], *where, self.id)
        camera, T = place.camera, place.T(self.robot.T_base_tcp(sight.joints_rad))
        x, y = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
        deep, zoom = FAR_M - NEAR_M, (2 * camera.fx / camera.width, 2 * camera.fy / camera.height)
        projection = np.array(
            [
                [zoom[0], 0, 1 - 2 * x, 0],
                [0, zoom[1], 2 * y - 1, 0],
                [0, 0, -(FAR_M + NEAR_M) / deep, -2 * FAR_M * NEAR_M / deep],
                [0, 0, -1, 0],
            ]
        )
        _, _, rgba, _, bodies = pybullet.getCameraImage(
            camera.width,
            camera.height,
            se3.invert(T @ OPENGL).T.ravel().tolist(),
            projection.T.ravel().tolist(),
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.id,
        )
        image = np.reshape(rgba, (camera.height, camera.width, 4))[..., :3].astype(np.uint8)
        image[np.reshape(bodies, image.shape[:2]) < 0] = GREY
        return image


def show_shapes() -> None:
    """From here on the twin's cameras see shapes."""
    made = views.TwinCameras.__init__

    def init(self: Any, run: RunFolder, start: Start, *args: Any, **more: Any) -> None:
        made(self, run, start, *args, **more)
        self._shapes = Shapes(start)

    def taken(self: Any, sight: Sight, names: list[str], _: RobotModel) -> views.Pictures:
        return {name: self._shapes.picture(self.viewpoints[name], sight) for name in names}

    views.TwinCameras.__init__, views.TwinCameras._taken = init, taken  # type: ignore[assignment,method-assign]


def rolled_out(folder: Path, policies: dict[str, str], mapping: Path) -> pd.Series:
    """How the rollout of each trial ended, by its task, start, policy and outcome."""
    for name, opened in policies.items():
        config = RolloutConfig(policy=opened, name=name, map=mapping, workers=1)
        runs.roll_out_run(RunFolder(folder), config, Output(quiet=True))
    table = pd.read_csv(folder / runs.TABLE).dropna(subset=["recorded", "sim_planned"])
    return table.set_index(["task", "start_id", "policy", "recorded"])["sim_planned"]


def main() -> None:
    """Roll out, compare and store."""
    run, mapping = map(Path, sys.argv[1:3])
    policies = dict(each.split("=") for each in sys.argv[3:])
    splats = rolled_out(run, policies, mapping)
    show_shapes()
    with tempfile.TemporaryDirectory() as folder:
        copy = copytree(run, Path(folder) / "run", ignore=ignore_patterns("*.rollout.*"))
        shapes = rolled_out(Path(copy), policies, mapping)
    both = pd.DataFrame({"splats": splats, "shapes": shapes}).dropna().reset_index()
    tried = both.groupby(["task", "start_id"])["policy"].transform("size")
    both = both[tried == len(policies)]
    rates = both.groupby(["task", "policy"])[["recorded", "splats", "shapes"]].mean()
    alike = {name: both["recorded"] == both[name] for name in ("splats", "shapes")}
    table: dict[str, Any] = {"alike": {name: int(each.sum()) for name, each in alike.items()}}
    targets = []
    for name, sim in rates[[*alike]].items():
        r, rank = pearson(rates["recorded"], sim), mmrv(recorded=rates["recorded"], sim=sim)
        targets.append(Target(what=f"r, {name}", measured=r, limit=0.85, at_most=False))
        targets.append(Target(what=f"MMRV, {name}", measured=rank, limit=0.05))
    for one, other in (("splats", "shapes"), ("shapes", "splats")):
        table[f"only {one} right"] = int((alike[one] & ~alike[other]).sum())
    print(rates.unstack("task").round(2).to_string(), table, sep="\n")
    report_targets("policy_mesh", targets, note=f"{len(both)} trials, stand-in", table=table)


if __name__ == "__main__":
    main()
