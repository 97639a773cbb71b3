"""A rebuilt scene whose parts can be put anywhere: a cloud for each state of robot and objects."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from twin.robot.posture import Posture
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud
from twin.scene.objects.decompose import ObjectSplats, read_objects, read_pose
from twin.scene.robot.splats import posed, read_links
from twin.scene.store.folder import SCENE_FILE, Scene


@dataclass(frozen=True, kw_only=True)
class MovableScene:
    """Everything that can be drawn, each part in its own frame."""

    background: GaussianCloud
    objects: Mapping[str, ObjectSplats]
    links: Mapping[str, GaussianCloud]
    T_root_base: Float[np.ndarray, "4 4"]
    """The robot's base in the scene's frame."""

    def at(
        self,
        Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
        posture: Posture | None = None,
        urdf: str = "",
        bent: Mapping[str, GaussianCloud] | None = None,
    ) -> GaussianCloud:
        """The cloud of one state: background, objects, robot, in this order.

        Args:
            Ts_base_object: Where objects are; the others are where they were scanned.
            posture: Of the robot; None: it is not drawn.
            urdf: The robot's description.
            bent: Objects that are no rigid bodies, already in the base frame.
        """
        bent = {} if bent is None else bent
        parts = [self.background]
        for name, item in self.objects.items():
            T = Ts_base_object.get(name, item.T_base_object)
            parts.append(bent[name] if name in bent else moved_cloud(item.cloud, T))
        if posture is not None and self.links:
            robot = posed(self.links, posture.joints_rad, urdf, width_m=posture.width_m)
            parts.append(moved_cloud(robot, self.T_root_base))
        return concatenate(parts)


def read_movable_scene(run: RunFolder, scene: Scene) -> MovableScene:
    """Load the parts that ``scene.json`` lists.

    Args:
        run: Whose scene folder is read.
        scene: The background and the record.

    Raises:
        PathNotFoundError: A splat file is gone.
        UnreadablePlyError: One is damaged.
        UnreadableSceneError: ``scene.json`` or an ``object.json`` cannot be understood.
    """
    root = scene.record.get("robot", {}).get("T_base_root")
    T_base_root = np.eye(4) if root is None else read_pose(root, run.scene_dir / SCENE_FILE)
    return MovableScene(
        background=scene.background,
        objects=read_objects(run, scene.record),
        links=read_links(run, scene.record),
        T_root_base=se3.invert(T_base_root),
    )
