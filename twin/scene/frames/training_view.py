"""One training image in memory, at half and at full size."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from bridge.geometry.camera import Camera
from twin.scene.frames.points import FrameSurface


@dataclass(frozen=True, kw_only=True)
class Target:
    """What a camera of one size should see; 8-bit in memory, float where it is used."""

    camera: Camera
    planes_u8: UInt8[np.ndarray, "3 height width"]
    depth_m: Float32[np.ndarray, "height width"]
    """Along the colour camera's axis; 0 where it was not measured."""
    static_mask: Bool[np.ndarray, "height width"]
    """False where something moving stood in the way; the fit passes these pixels over."""

    def image(self) -> Float32[np.ndarray, "3 height width"]:
        """Colour planes, 0..1."""
        return self.planes_u8.astype(np.float32) * np.float32(1 / 255)

    def without(self, hit: Bool[np.ndarray, "height width"]) -> "Target":
        """The same with some pixels passed over, beside those that already are."""
        return replace(
            self,
            static_mask=self.static_mask & ~hit,
            depth_m=np.where(hit, np.float32(0.0), self.depth_m),
        )


@dataclass(frozen=True, kw_only=True)
class TrainingView:
    """One training image with its pose."""

    camera_id: str
    stamp_ns: int
    T_base_color: Float[np.ndarray, "4 4"]
    half: Target
    full: Target

    def without(self, half_hit: Bool[np.ndarray, "half_height half_width"]) -> "TrainingView":
        """The same with some pixels of the half-size image passed over, at both sizes."""
        if not half_hit.any():
            return self
        height, width = self.full.depth_m.shape
        hit = np.repeat(np.repeat(half_hit, 2, axis=0), 2, axis=1)[:height, :width]
        return replace(self, half=self.half.without(half_hit), full=self.full.without(hit))


def training_view(surface: FrameSurface) -> TrainingView:
    """Prepare one frame; the half-size image is the mean of 2 x 2 pixels."""
    frame = surface.frame
    depth_m = surface.depth_in_color_camera()
    half = _halved_camera(frame.color_camera)
    return TrainingView(
        camera_id=frame.camera_id,
        stamp_ns=frame.stamp_ns,
        T_base_color=frame.T_base_color,
        half=_target(half, _halved_image(frame.image_u8, half), _halved_depth(depth_m, half)),
        full=_target(frame.color_camera, frame.image_u8, depth_m),
    )


def _target(camera: Camera, image_u8: np.ndarray, depth_m: np.ndarray) -> Target:
    planes = np.ascontiguousarray(np.moveaxis(image_u8, -1, 0))
    everywhere = np.ones(depth_m.shape, dtype=bool)
    return Target(camera=camera, planes_u8=planes, depth_m=depth_m, static_mask=everywhere)


def _halved_camera(camera: Camera) -> Camera:
    """The camera whose pixels are blocks of 2 x 2, exactly: an odd edge makes a whole block."""
    return replace(
        camera,
        width=-(-camera.width // 2),
        height=-(-camera.height // 2),
        fx=camera.fx / 2,
        fy=camera.fy / 2,
        cx=camera.cx / 2,
        cy=camera.cy / 2,
    )


def _blocks(rows: np.ndarray, camera: Camera) -> np.ndarray:
    """Group 2 x 2 pixels: (height, 2, width, 2, ...); an odd edge is repeated."""
    height, width = camera.height * 2, camera.width * 2
    missing = ((0, height - len(rows)), (0, width - rows.shape[1]))
    padded = np.pad(rows, missing + ((0, 0),) * (rows.ndim - 2), mode="edge")
    shape = (camera.height, 2, camera.width, 2, *rows.shape[2:])
    return np.asarray(padded.reshape(shape))


def _halved_image(image_u8: np.ndarray, camera: Camera) -> np.ndarray:
    total = _blocks(image_u8, camera).sum(axis=(1, 3), dtype=np.uint16)
    return np.asarray((total + 2) // 4, dtype=np.uint8)


def _halved_depth(depth_m: np.ndarray, camera: Camera) -> np.ndarray:
    """Nearest measurement of each block; blocks without one stay 0."""
    known = np.where(depth_m > 0, depth_m, np.float32(np.inf))
    nearest = _blocks(known, camera).min(axis=(1, 3))
    return np.where(np.isfinite(nearest), nearest, np.float32(0.0))
