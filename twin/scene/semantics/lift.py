"""From images to Gaussians and back: masks and feature maps through the weights of drawing.

With w_gp = alpha_g T_g the share of pixel p that Gaussian g gives it, a drawn image is A c with
A = (w_gp). Its transpose carries what pixels know to the Gaussians they show, in closed form:
F_g = sum_vp w_gvp f_vp / sum_vp w_gvp over views v (the optimum of FlashSplat, the lifting of
LUDVIG). No gradients, no iterations.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int, UInt16

from bridge.geometry.camera import Camera
from twin.naming.things import FeatureMap, MaskSet, SemanticsError
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.raster.rasteriser import Rasteriser

MIN_WEIGHT = 0.05
"""A Gaussian that gives a frame less than this share of one pixel is not seen in it."""


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Where a camera stood."""

    camera: Camera
    T_base_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What the masks of one frame say about the Gaussians it shows."""

    splat_ids: Int[np.ndarray, " num_visible"]
    weight: Float32[np.ndarray, " num_visible"]
    """Pixels' worth of the image that each gives."""
    inside: Float32[np.ndarray, "num_visible num_masks"]
    """Share of that within each mask, 0..1."""
    labels: tuple[str, ...]
    scores: tuple[float, ...]


def observe(
    rasteriser: Rasteriser, cloud: GaussianCloud, viewpoint: Viewpoint, masks: MaskSet
) -> Observation:
    """Carry the masks of one frame to the Gaussians."""
    camera = viewpoint.camera
    for number, mask in enumerate(masks.masks):
        if mask.image.shape != (camera.height, camera.width):
            message = (
                f"mask {number} ({mask.label!r}) of camera {masks.camera_id} at "
                f"{masks.stamp_ns} ns is {mask.image.shape[1]} x {mask.image.shape[0]} pixels, "
                f"the camera's image {camera.width} x {camera.height}. Give masks of the image's "
                "own size."
            )
            raise SemanticsError(message)
    images = [mask.image for mask in masks.masks]
    whole = np.ones((camera.height, camera.width), dtype=bool)
    stack = np.stack([whole, *images]).astype(np.float32)
    lifted = _transposed(rasteriser, cloud, viewpoint, stack)
    ids = np.flatnonzero(lifted[:, 0] > MIN_WEIGHT)
    weight = lifted[ids, 0]
    return Observation(
        splat_ids=ids,
        weight=weight,
        inside=as_float32(np.clip(lifted[ids, 1:] / weight[:, None], 0.0, 1.0)),
        labels=tuple(mask.label for mask in masks.masks),
        scores=tuple(float(mask.score) for mask in masks.masks),
    )


def _transposed(
    rasteriser: Rasteriser,
    cloud: GaussianCloud,
    viewpoint: Viewpoint,
    maps: Float32[np.ndarray, "num_channels height width"],
) -> Float32[np.ndarray, "num_splats num_channels"]:
    """A^T of one view on any number of channels."""
    rasteriser.draw_planes(cloud, viewpoint.camera, viewpoint.T_base_camera)
    return rasteriser.lift(maps)


def lift_features(
    rasteriser: Rasteriser,
    cloud: GaussianCloud,
    frames: Iterable[tuple[Viewpoint, FeatureMap]],
) -> tuple[Float32[np.ndarray, "num_splats num_channels"], Float32[np.ndarray, " num_splats"]]:
    """Average the feature maps of all frames on each Gaussian.

    The Gaussians are drawn at the maps' own resolution: a feature cell is a pixel.

    Returns:
        Features, and how many cells' worth each Gaussian gave; both zero where never seen.
    """
    total, weight = None, np.zeros(len(cloud), dtype=np.float32)
    for viewpoint, feature_map in frames:
        channels, height, width = feature_map.values.shape
        small = camera_of_cells(viewpoint.camera, feature_map)
        if total is None:
            total = np.zeros((len(cloud), channels), dtype=np.float32)
        elif channels != total.shape[1]:
            message = f"a feature map has {channels} channels, those before {total.shape[1]}."
            raise SemanticsError(message)
        ones = np.ones((1, height, width), dtype=np.float32)
        stack = np.concatenate([ones, feature_map.values])
        at = Viewpoint(camera=small, T_base_camera=viewpoint.T_base_camera)
        lifted = _transposed(rasteriser, cloud, at, stack)
        weight += lifted[:, 0]
        total += lifted[:, 1:]
    if total is None:
        message = "there is no frame with features to lift."
        raise SemanticsError(message)
    seen = weight > 1e-4
    features = np.where(seen[:, None], total / np.where(seen, weight, 1.0)[:, None], 0.0)
    return as_float32(features), np.where(seen, weight, 0.0).astype(np.float32)


def camera_of_cells(camera: Camera, feature_map: FeatureMap) -> Camera:
    """The camera whose pixels are the feature cells; the last cells may reach over the edge."""
    _, height, width = feature_map.values.shape
    stride = feature_map.stride
    if (
        stride < 1
        or abs(width * stride - camera.width) >= 2 * stride
        or (abs(height * stride - camera.height) >= 2 * stride)
    ):
        message = (
            f"a feature map of {width} x {height} cells, {stride} pixels each, does not fit an "
            f"image of {camera.width} x {camera.height}."
        )
        raise SemanticsError(message)
    return Camera(
        width=width,
        height=height,
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=camera.cx / stride,
        cy=camera.cy / stride,
    )


def render_labels(
    rasteriser: Rasteriser,
    cloud: GaussianCloud,
    labels: UInt16[np.ndarray, " num_splats"],
    viewpoint: Viewpoint,
) -> UInt16[np.ndarray, "height width"]:
    """Per pixel the label that gives it most; 0 also where empty space gives more."""
    planes = rasteriser.draw_planes(cloud, viewpoint.camera, viewpoint.T_base_camera)
    ids, weight = rasteriser.label_map(labels)
    ids[weight <= 1.0 - planes[4]] = 0
    return ids


def visible_weight(
    rasteriser: Rasteriser, cloud: GaussianCloud, viewpoint: Viewpoint
) -> Float32[np.ndarray, " num_splats"]:
    """Pixels' worth of one camera's image that each Gaussian gives."""
    camera = viewpoint.camera
    ones = np.ones((1, camera.height, camera.width), dtype=np.float32)
    return as_float32(_transposed(rasteriser, cloud, viewpoint, ones)[:, 0])
