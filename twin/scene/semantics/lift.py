"""From images to Gaussians and back, through the weights of drawing.

With w_gp = alpha_g T_g the share of pixel p that Gaussian g gives it, a drawn image is A c with
A = (w_gp). Its transpose carries what pixels know to the Gaussians they show, in closed form (the
optimum of FlashSplat, the lifting of LUDVIG). No gradients, no iterations.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt16

from bridge.geometry.camera import Camera
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Where a camera stood."""

    camera: Camera
    T_base_camera: Float[np.ndarray, "4 4"]


def lifted(
    rasteriser: Rasteriser,
    cloud: GaussianCloud,
    viewpoint: Viewpoint,
    maps: Float32[np.ndarray, "num_maps height width"],
) -> Float32[np.ndarray, "num_splats num_maps"]:
    """A^T of one view: how much of each map each Gaussian shows, in pixels' worth."""
    rasteriser.draw_planes(cloud, viewpoint.camera, viewpoint.T_base_camera)
    return rasteriser.lift(maps)


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
