"""From what an ideal camera sees to what a cheap one delivers."""

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from bridge.sources.standin.cell_file import SensorModel
from bridge.sources.standin.hidden import HiddenParameters
from bridge.sources.standin.render import Picture

GAP_AT_EDGE_FRACTION = 0.6
"""Share of pixels without depth beside a jump in depth, where a stereo pair finds no match."""
EDGE_JUMP = 0.05
"""A jump, as a fraction of the distance."""


def measure_depth(
    picture: Picture,
    model: SensorModel,
    hidden: HiddenParameters,
    rng: np.random.Generator,
) -> UInt16[np.ndarray, "height width"]:
    """Depth in whole millimetres with bias, noise and holes; 0 is "no measurement"."""
    true_m = np.where(np.isfinite(picture.depth_m), picture.depth_m, 0.0)
    noise = rng.standard_normal(true_m.shape, dtype=np.float32)
    sigma_m = model.depth_noise_per_m * true_m**2
    seen_m = true_m * hidden.depth_scale + hidden.depth_offset_m + sigma_m * noise
    valid = (true_m > model.depth_min_m) & (true_m < model.depth_max_m)
    valid &= picture.cosine > model.grazing_cosine
    edge = _beside_jump(true_m)
    valid[edge] &= rng.random(int(edge.sum())) > GAP_AT_EDGE_FRACTION
    return np.where(valid, np.rint(seen_m * 1e3), 0).astype(np.uint16)


def _beside_jump(depth_m: Float[np.ndarray, "height width"]) -> np.ndarray:
    mask = np.zeros(depth_m.shape, dtype=bool)
    across = np.abs(np.diff(depth_m, axis=1)) > EDGE_JUMP * depth_m[:, 1:]
    down = np.abs(np.diff(depth_m, axis=0)) > EDGE_JUMP * depth_m[1:]
    # The far side of an edge is the one hidden from the second imager.
    mask[:, 1:] |= across & (depth_m[:, 1:] > depth_m[:, :-1])
    mask[:, :-1] |= across & (depth_m[:, :-1] > depth_m[:, 1:])
    mask[1:] |= down & (depth_m[1:] > depth_m[:-1])
    mask[:-1] |= down & (depth_m[:-1] > depth_m[1:])
    return mask


def measure_color(
    picture: Picture,
    model: SensorModel,
    hidden: HiddenParameters,
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "height width 3"]:
    """Colour with the exposure's gain and noise."""
    noise = rng.standard_normal(picture.image.shape, dtype=np.float32)
    levels = picture.image * np.float32(255.0 * hidden.image_gain)
    return np.clip(levels + np.float32(model.image_noise) * noise + 0.5, 0, 255).astype(np.uint8)
