"""A rebuilt scene whose parts can be put anywhere: a cloud for each state of robot and objects."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.ndimage import binary_dilation

from bridge.episode.run_folder import RunFolder
from bridge.geometry.camera import Camera
from bridge.media.palette import rgb
from twin.robot.posture import Posture
from twin.scene.backdrop import Backdrop, read_backdrop
from twin.scene.fit.lighting import EVEN, Lighting, read_lighting
from twin.scene.gaussians import GaussianCloud, as_float32, concatenate, moved_cloud
from twin.scene.objects.decompose import ObjectSplats, read_objects, uncovered
from twin.scene.raster.backend import CudaRasteriser
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.robot.splats import posed, read_links
from twin.scene.store.folder import Scene
from twin.scene.store.library import NOT_SCANNED

SEEN = 0.5
"""Least weight of measured Gaussians in a pixel that shows what was seen in the scan, and of an
object in one that shows it."""
DASH_PX = 4
"""Dashes of the outline around what was not scanned."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One instant as it is to be drawn."""

    stamp_ns: int
    T_base_camera: Float[np.ndarray, "4 4"]
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]]
    posture: Posture | None
    """None: no robot is drawn."""
    urdf: str
    """Of the robot."""


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """One state as it was drawn."""

    image_u8: UInt8[np.ndarray, "height width 3"]
    """What the cameras would have seen: this is compared with what they saw."""
    depth_m: Float32[np.ndarray, "height width"]
    alpha: Float32[np.ndarray, "height width"]
    seen_mask: Bool[np.ndarray, "height width"]
    """Pixels that show what was measured in the scan, and not what was completed."""
    not_scanned: Mapping[str, Bool[np.ndarray, "height width"]] = field(default_factory=dict)
    """By object that no scan saw: the pixels that show it."""

    def marked_u8(self) -> UInt8[np.ndarray, "height width 3"]:
        """The image for people: what was not scanned has a dashed outline and is named."""
        image = self.image_u8
        for name, mask in self.not_scanned.items():
            image = outlined(image, mask, f"{name}: {NOT_SCANNED}") if mask.any() else image
        return image


def outlined(
    image_u8: UInt8[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
    words: str,
) -> UInt8[np.ndarray, "height width 3"]:
    """The image with dashes around a mask, and words above it."""
    from PIL import Image as pillow  # noqa: PLC0415  # heavy, only for what was not scanned
    from PIL import ImageDraw  # noqa: PLC0415

    rows, columns = np.nonzero(binary_dilation(mask, iterations=2) & ~mask)
    marked = image_u8.copy()
    dark = (rows + columns) // DASH_PX % 2 == 0
    marked[rows, columns] = np.where(dark[:, None], np.uint8(0), np.array(rgb("unknown"), "u1"))
    picture = pillow.fromarray(marked)
    pen, (top, left) = ImageDraw.Draw(picture), np.argwhere(mask).min(axis=0)
    box = pen.textbbox((0, 0), words)
    at = min(max(left, 1), max(mask.shape[1] - box[2] - 2, 1)), max(top - box[3] - 4, 1)
    pen.rectangle((at[0] - 1, at[1], at[0] + box[2] + 1, at[1] + box[3] + 1), fill=(0, 0, 0))
    pen.text(at, words, fill=rgb("unknown"))
    return np.asarray(picture)


@dataclass(frozen=True, kw_only=True)
class MovableScene:
    """Everything that can be drawn, each part in its own frame."""

    background: GaussianCloud
    objects: Mapping[str, ObjectSplats]
    """Those that are drawn."""
    links: Mapping[str, GaussianCloud]
    lighting: Lighting = EVEN
    """On the links."""
    backdrop: Backdrop | None = None
    """What stands behind everything; None: black."""
    not_scanned: frozenset[str] = frozenset()
    """Objects that no scan saw: drawn from the task's shape."""

    def drawn_as(
        self, rasteriser: Rasteriser | CudaRasteriser, camera: Camera, frame: Frame
    ) -> Drawn:
        """Draw the scene as it is at one instant."""
        cloud = self.at(frame.Ts_base_object, frame.posture, frame.urdf)
        return self.draw(rasteriser, cloud, camera, frame.T_base_camera)

    def draw(
        self,
        rasteriser: Rasteriser | CudaRasteriser,
        cloud: GaussianCloud,
        camera: Camera,
        T_base_camera: Float[np.ndarray, "4 4"],
    ) -> Drawn:
        """Draw a cloud of ``at``, with the backdrop where there is nothing.

        Args:
            cloud: More may stand behind its last Gaussian.
        """
        view = rasteriser.view(cloud, camera, T_base_camera)
        flags = [~cloud.completed]
        first = len(self.background)
        for name, item in self.objects.items():
            if name in self.not_scanned:
                flags.append(np.zeros(len(cloud), dtype=bool))
                flags[-1][first : first + len(item.cloud)] = True
                flags[0] = flags[0] & ~flags[-1]
            first += len(item.cloud)
        shown = rasteriser.draw_features(as_float32(np.stack(flags, axis=1))) >= SEEN
        if self.backdrop is not None:
            view = self.backdrop.behind(view, camera, T_base_camera)
        names = [name for name in self.objects if name in self.not_scanned]
        return Drawn(
            image_u8=view.image_u8(),
            depth_m=view.depth_m,
            alpha=view.alpha,
            seen_mask=shown[0],
            not_scanned=dict(zip(names, shown[1:], strict=True)),
        )

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
            bent: Objects that are no rigid bodies, already in the base frame.
        """
        bent = {} if bent is None else bent
        placed = {
            name: Ts_base_object.get(name, item.T_base_object)
            for name, item in self.objects.items()
            if name not in bent
        }
        parts = [uncovered(self.background, self.objects, placed)]
        for name in self.objects:
            parts.append(bent[name] if name in bent else self.object_at(name, placed))
        if posture is not None and self.links:
            parts.append(self.robot_at(posture, urdf))
        return concatenate(parts)

    def object_at(
        self, name: str, Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]]
    ) -> GaussianCloud:
        """One object's part of that cloud; where it was scanned unless a place is given.

        It has the colours that it showed there: where it is turned, it is lit anew.
        """
        item = self.objects[name]
        scanned = moved_cloud(item.cloud, item.T_base_object)
        placed = moved_cloud(item.cloud, Ts_base_object.get(name, item.T_base_object))
        before, after = (self.lighting.on(cloud).colors for cloud in (scanned, placed))
        return replace(placed, colors=placed.colors * after / np.maximum(before, 1e-6))

    def robot_at(self, posture: Posture, urdf: str) -> GaussianCloud:
        """The robot's part of that cloud; there must be links."""
        return posed(self.links, posture, urdf, self.lighting)


def read_movable_scene(
    run: RunFolder, scene: Scene, wanted: Iterable[str] | None = None
) -> MovableScene:
    """Load the parts that ``scene.json`` lists, of its objects those that are wanted."""
    return MovableScene(
        background=scene.background,
        objects=read_objects(run, scene.record, wanted),
        links=read_links(run, scene.record),
        lighting=read_lighting(scene.record),
        backdrop=read_backdrop(run, scene.record),
    )
