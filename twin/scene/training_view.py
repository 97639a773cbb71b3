"""One training image in memory, at half and at full size."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from bridge.episode.streams import RgbdFrame
from bridge.geometry.camera import Camera
from twin.scene.points import depth_in_color_camera


@dataclass(frozen=True, kw_only=True)
class Target:
    """What a camera of one size should see; 8-bit in memory, float where it is used."""

    camera: Camera
    planes_u8: UInt8[np.ndarray, "3 height width"]
    depth_m: Float32[np.ndarray, "height width"]
    """Along the colour camera's axis; 0 where it was not measured."""

    def image(self) -> Float32[np.ndarray, "3 height width"]:
        """Colour planes, 0..1."""
        return self.planes_u8.astype(np.float32) * np.float32(1 / 255)


@dataclass(frozen=True, kw_only=True)
class TrainingView:
    """One training image with its pose."""

    camera_id: str
    stamp_ns: int
    T_base_color: Float[np.ndarray, "4 4"]
    half: Target
    full: Target


def training_view(frame: RgbdFrame, *, flying_fraction: float, max_depth_m: float) -> TrainingView:
    """Prepare one frame; the half-size image is the mean of 2 x 2 pixels."""
    targets = []
    for factor in (0.5, 1.0):
        camera = frame.color_camera.scaled(factor)
        image = frame.image_u8 if factor == 1.0 else _halved(frame.image_u8, camera)
        depth = depth_in_color_camera(
            frame, camera, flying_fraction=flying_fraction, max_depth_m=max_depth_m
        )
        planes = np.ascontiguousarray(np.moveaxis(image, -1, 0))
        targets.append(Target(camera=camera, planes_u8=planes, depth_m=depth))
    return TrainingView(
        camera_id=frame.camera_id,
        stamp_ns=frame.stamp_ns,
        T_base_color=frame.T_base_color,
        half=targets[0],
        full=targets[1],
    )


def _halved(image_u8: np.ndarray, camera: Camera) -> np.ndarray:
    height, width = camera.height * 2, camera.width * 2
    padded = np.pad(
        image_u8,
        ((0, max(0, height - len(image_u8))), (0, max(0, width - image_u8.shape[1])), (0, 0)),
        mode="edge",
    )[:height, :width]
    blocks = padded.reshape(camera.height, 2, camera.width, 2, 3)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
