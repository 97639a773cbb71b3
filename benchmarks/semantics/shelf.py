"""The real wrist-camera set and its own masks."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measure import ROOT
from PIL import Image
from scipy import ndimage

from bridge.episode.streams import RgbdFrame
from bridge.geometry.camera import Camera
from twin.scene.frames.rgbd import DepthLimits
from twin.scene.semantics.lift import Viewpoint

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
