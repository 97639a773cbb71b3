"""The real Kinect frames of the 7-Scenes kitchen, where they are at hand."""

import os
from pathlib import Path

import numpy as np

from bridge.episode.streams import RgbdFrame

ROOT = Path(__file__).resolve().parents[2]
TRAIN_EVERY, HELD_OUT_AFTER = 5, 2


def kitchen_folder() -> Path | None:
    """Where the frames lie; None without them."""
    data = Path(os.environ.get("GST_SHARED_DATA", ROOT.parent / "shared" / "data"))
    folder = data / "rgbd_7scenes_redkitchen_a"
    return folder if (folder / "scene.json").is_file() else None


def load(folder: Path) -> tuple[list[RgbdFrame], list[RgbdFrame]]:
    """Every fifth frame trains; the frame two after each is held out."""
    from PIL import Image

    from bridge.sources.folder.frames import read_stored_depth
    from bridge.sources.folder.messages import read_index

    index = read_index(folder)

    def frame(number: int) -> RgbdFrame:
        item = index.frames[number]
        stored = read_stored_depth(item.depth_path)
        valid = ~np.isin(stored, index.depth_invalid_values)
        return RgbdFrame(
            camera_id="kinect",
            stamp_ns=1_000_000_000 + number * 33_333_333,
            image_u8=np.asarray(Image.open(item.color_path).convert("RGB")),
            depth_m=(stored * valid * index.depth_unit_m).astype(np.float32),
            color_camera=index.color_camera or index.depth_camera,
            depth_camera=index.depth_camera,
            T_base_color=item.T_world_depth @ index.T_depth_color,
            T_base_depth=item.T_world_depth,
        )

    numbers = range(0, len(index.frames), TRAIN_EVERY)
    held_out = [number + HELD_OUT_AFTER for number in numbers]
    return [frame(n) for n in numbers], [frame(n) for n in held_out if n < len(index.frames)]
