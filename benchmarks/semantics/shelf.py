"""The real wrist-camera set: its own masks lifted, and the default segmenter on it."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measure import ROOT, Target
from overlap import mask_iou
from PIL import Image
from scipy import ndimage

from bridge.episode.streams import RgbdFrame
from bridge.geometry.camera import Camera
from twin.naming.things import Mask, MaskSet
from twin.scene.fit.initialise import fuse
from twin.scene.frames.rgbd import DepthLimits, FrameSurface
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.semantics.describe import scene_by_default, scene_from_masks
from twin.scene.semantics.lift import Viewpoint, render_labels
from twin.scene.settings import InitialiseConfig

DATA = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
FOLDER = DATA / "rgbd_apc_shelf_wristcam"
HELD_OUT_EVERY = 3
LIMITS = DepthLimits(max_depth_m=1.2, flying_fraction=0.03)


@dataclass(frozen=True)
class ShelfShot:
    """One real frame and the ids of its supplied masks."""

    frame: RgbdFrame
    ids: np.ndarray

    @property
    def viewpoint(self) -> Viewpoint:
        """Where the camera stood, says the robot."""
        return Viewpoint(camera=self.frame.color_camera, T_base_camera=self.frame.T_base_color)


def load_shots() -> list[ShelfShot]:
    """All frames with their masks; depth is rotated by three bits, 0.1 mm."""
    index = json.loads((FOLDER / "scene.json").read_text())
    lens = index["depth_intrinsics"]
    camera = Camera.from_ros(
        **{key: lens[key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
    )
    shots = []
    for item in index["frames"]:
        stored = np.array(Image.open(FOLDER / item["depth"])).astype(np.uint16)
        depth_m = filled(((stored >> 3) | (stored << 13)).astype(np.float64) * 1e-4)
        image = np.array(Image.open(FOLDER / item["color"]).convert("RGB"))
        name = f"{Path(item['color']).name.split('.')[0]}.segm.png"
        T = np.array(item["T_world_cam"], dtype=np.float64)
        frame = RgbdFrame(
            camera_id="wrist",
            stamp_ns=int(item["id"]),
            image_u8=image,
            depth_m=depth_m,
            color_camera=camera,
            depth_camera=camera,
            T_base_color=T,
            T_base_depth=T,
        )
        shots.append(ShelfShot(frame, np.array(Image.open(FOLDER / "segm" / name))))
    return shots


def filled(depth_m: np.ndarray) -> np.ndarray:
    """Depth warped to the colour camera has gaps: the mean of a 5 x 5 neighbourhood that agrees."""
    known = (depth_m > 0.2).astype(np.float64)
    depth = depth_m * known
    share, mean, square = (
        ndimage.uniform_filter(values, 5) for values in (known, depth, depth * depth)
    )
    enough = share > 3.5 / 25
    mean = mean / np.maximum(share, 1e-9)
    spread = np.sqrt(np.maximum(square / np.maximum(share, 1e-9) - mean**2, 0.0))
    return np.where(enough & (spread < 0.012), mean, 0.0).astype(np.float32)


def fused(shots: list[ShelfShot]) -> GaussianCloud:
    """Gaussians of the training frames as they come out of the depth, not fitted."""
    points = [FrameSurface(shot.frame, LIMITS).points() for shot in shots]
    return fuse(points, InitialiseConfig(max_splats=120_000))


def supplied(shot: ShelfShot) -> MaskSet:
    """The supplied masks of a frame."""
    masks = [
        Mask(image=shot.ids == number, label=f"object {number}")
        for number in np.unique(shot.ids)
        if number
    ]
    return MaskSet(camera_id="wrist", stamp_ns=shot.frame.stamp_ns, masks=masks, source="supplied")


def targets(rasteriser: Rasteriser) -> list[Target]:
    """Mean IoU over objects and frames; nothing where the data are missing."""
    if not FOLDER.is_dir():
        print(f"shelf left out: {FOLDER} is not there (GST_SHARED_DATA)")
        return []
    shots = load_shots()
    train = [s for k, s in enumerate(shots) if k % HELD_OUT_EVERY != HELD_OUT_EVERY - 1]
    held_out = [s for k, s in enumerate(shots) if k % HELD_OUT_EVERY == HELD_OUT_EVERY - 1]
    cloud = fused(train)
    lifted = scene_from_masks(cloud, [(s.viewpoint, supplied(s)) for s in train], rasteriser)
    names = {item.label: item.id for item in lifted.instances}
    rows = []
    for what, some in (("all", shots), ("held-out", held_out)):
        scores = []
        for shot in some:
            ids = render_labels(rasteriser, cloud, lifted.labels, shot.viewpoint)
            for mask in supplied(shot).masks:
                found = ids == names.get(mask.label, -1)
                scores.append(mask_iou(found, mask.image) or 0.0)
        rows.append(
            Target(
                what=f"shelf: lifted supplied masks, {what} views, mean IoU",
                measured=float(np.mean(scores)),
                limit=0.8,
                at_most=False,
                reference=f"{len(scores)} masks, worst {min(scores):.2f}",
            )
        )
    default = scene_by_default(cloud, [s.viewpoint for s in train], rasteriser)
    scores = []
    for shot in held_out:
        ids = render_labels(rasteriser, cloud, default.labels, shot.viewpoint)
        for mask in supplied(shot).masks:
            options = [mask_iou(ids == k, mask.image) or 0.0 for k in np.unique(ids) if k]
            scores.append(max(options, default=0.0))
    rows.append(
        Target(
            what="shelf: default segmenter, held-out views, mean IoU (reported)",
            measured=float(np.mean(scores)),
            limit=0.0,
            at_most=False,
            reference=default.remark or f"{len(default.instances)} instances",
        )
    )
    return rows
