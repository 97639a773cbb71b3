"""A rebuilt scene whose parts can be put anywhere: a cloud for each state of robot and objects."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.robot.posture import Posture
from twin.scene.backdrop import Backdrop, read_backdrop
from twin.scene.gaussians import GaussianCloud, concatenate, moved_cloud
from twin.scene.objects.decompose import ObjectSplats, read_objects, read_pose
from twin.scene.raster.rasteriser import View
from twin.scene.robot.lighting import EVEN, Lighting, read_lighting
from twin.scene.robot.splats import posed, read_links
from twin.scene.store.folder import SCENE_FILE, Scene

UNDER_M = 0.008
"""Background this far below an object is covered by it."""
TRANSPARENT_LOGIT = -30.0
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class MovableScene:
    """Everything that can be drawn, each part in its own frame."""

    background: GaussianCloud
    objects: Mapping[str, ObjectSplats]
    links: Mapping[str, GaussianCloud]
    T_root_base: Float[np.ndarray, "4 4"]
    """The robot's base in the scene's frame."""
    lighting: Lighting = EVEN
    """On the links."""
    backdrop: Backdrop | None = None
    """What stands behind everything; None: black."""

    def behind(self, view: View, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]) -> View:
        """A view of one state, with the backdrop where nothing was drawn."""
        if self.backdrop is None:
            return view
        return self.backdrop.behind(view, camera, T_base_camera)

    def at(
        self,
        Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
        posture: Posture | None = None,
        urdf: str = "",
        bent: Mapping[str, GaussianCloud] | None = None,
    ) -> GaussianCloud:
        """The cloud of one state: background, objects, robot, in this order.

        Background that an object covers is not drawn: in it, or just under it. Gaussians are
        ordered by their centres, so a table 6 mm below the floor of a box would show through it.

        Args:
            Ts_base_object: Where objects are; the others are where they were scanned.
            posture: Of the robot; None: it is not drawn.
            bent: Objects that are no rigid bodies, already in the base frame.
        """
        bent = {} if bent is None else bent
        placed = {
            name: Ts_base_object.get(name, item.T_base_object)
            for name, item in self.objects.items()
            if name not in bent
        }
        parts = [self._uncovered(placed)]
        for name, item in self.objects.items():
            own = bent[name] if name in bent else moved_cloud(item.cloud, placed[name])
            parts.append(own)
        if posture is not None and self.links:
            robot = posed(
                self.links,
                posture.joints_rad,
                urdf,
                width_m=posture.width_m,
                lighting=self.lighting,
            )
            parts.append(moved_cloud(robot, self.T_root_base))
        return concatenate(parts)

    def _uncovered(self, placed: Mapping[str, Float[np.ndarray, "4 4"]]) -> GaussianCloud:
        """The background, transparent where closed objects stand in it or on it."""
        means = self.background.means_m
        opacities = self.background.opacities_logit.copy()
        for name, T in placed.items():
            sdf = self.objects[name].sdf
            if sdf is None:
                continue
            reach_m = sdf.voxel_m * float(np.linalg.norm(sdf.values_m.shape)) + UNDER_M
            near = np.abs(means - T[:3, 3].astype(np.float32)).max(axis=1) < reach_m
            ids = np.flatnonzero(near)
            p = means[ids].astype(np.float64)
            for up_m in (0.0, UNDER_M / 2, UNDER_M):
                lifted = se3.apply(se3.invert(T), p + up_m * UP)
                opacities[ids[sdf.distance(lifted) < 0]] = TRANSPARENT_LOGIT
        return replace(self.background, opacities_logit=opacities)


def read_movable_scene(run: RunFolder, scene: Scene) -> MovableScene:
    """Load the parts that ``scene.json`` lists."""
    root = scene.record.get("robot", {}).get("T_base_root")
    T_base_root = np.eye(4) if root is None else read_pose(root, run.scene_dir / SCENE_FILE)
    return MovableScene(
        background=scene.background,
        objects=read_objects(run, scene.record),
        links=read_links(run, scene.record),
        T_root_base=se3.invert(T_base_root),
        lighting=read_lighting(scene.record),
        backdrop=read_backdrop(run, scene.record),
    )
