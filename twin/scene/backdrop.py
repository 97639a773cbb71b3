"""What stands behind everything: a far shell in the colours that cameras saw in each direction.

No training view says what lies in a corner that none of them looked at. Drawn black it is a hole
in every picture; drawn in the colours seen beside it, it is a wall or a floor out of focus. The
shell is a picture by direction alone, as far away as can be, not Gaussians: other viewers,
distances and hashes know nothing of it. Pixels that show it count as unseen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from scipy import ndimage

from bridge.episode.run_folder import RunFolder
from bridge.geometry.camera import Camera
from bridge.media.color import UnreadableImageError, decode_color, encode_png
from bridge.whole_file import write_whole
from twin.errors import UnreadableFileError
from twin.scene.frames.rgbd import TrainingView
from twin.scene.gaussians import GaussianCloud
from twin.scene.raster.rasteriser import Rasteriser, View

BACKDROP = "backdrop.png"
"""In the scene folder: the shell, heading along its width, straight up in the first row."""
ROWS, COLUMNS = 48, 96
STEP_PX = 4
"""Every so many pixels of a half-size training image say what colour lies there."""
SEEN_WEIGHT = 0.02
"""Of a pixel in which something is drawn, beside 1 where nothing is: a wall that has no Gaussians
looks most like what stands before it where nothing else is known."""
NEAR_RAD = 0.06
"""Colours of directions nearer than this are averaged; farther ones lose weight with the fourth
power of the angle (Shepard 1968)."""
OPAQUE = 0.7
"""Pixels with this much drawn are left alone, however little is missing: the fit saw black there
and has made up for it."""
FADES = 0.4


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """A sphere seen from its middle."""

    colors: Float32[np.ndarray, "num_rows num_columns 3"]
    """0..1, rows from straight up to straight down, columns by heading from -pi on, in the scene's
    frame, whose z axis points up."""

    def behind(self, view: View, camera: Camera, T_base_camera: Float[np.ndarray, "4 4"]) -> View:
        """The same view, with the shell where nothing was drawn; depth and alpha do not change."""
        weight = (1 - view.alpha) * np.clip((OPAQUE - view.alpha) / FADES, 0.0, 1.0)
        rows, columns = np.nonzero(weight > 0)
        if not len(rows):
            return view
        rays = camera.rays()[rows, columns] @ T_base_camera[:3, :3].T
        places = _places(rays, self.colors.shape[:2])
        image = view.image.copy()
        for channel in range(3):
            # With a column more on either side, for headings near the seam.
            wrapped = np.pad(self.colors[..., channel], ((0, 0), (1, 1)), mode="wrap")
            behind = ndimage.map_coordinates(wrapped, places, order=1, mode="nearest")
            image[rows, columns, channel] += weight[rows, columns] * behind
        return replace(view, image=image)

    def write(self, folder: Path) -> dict[str, Any]:
        """Write the picture; returns what ``scene.json`` says of it."""
        pixels = np.rint(np.clip(self.colors, 0.0, 1.0) * 255.0).astype(np.uint8)
        write_whole(folder / BACKDROP, encode_png(pixels))
        return {"file": BACKDROP}


def _places(
    rays: Float[np.ndarray, "num_rays 3"], shape: tuple[int, ...]
) -> Float[np.ndarray, "2 num_rays"]:
    """Rows and columns, fractional, of a picture that has one more column on either side."""
    heading = np.arctan2(rays[:, 1], rays[:, 0])
    down = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    rows, columns = shape
    return np.stack([down / np.pi * rows - 0.5, (heading / (2 * np.pi) + 0.5) * columns + 0.5])


def backdrop_of(
    cloud: GaussianCloud, views: Sequence[TrainingView], rasteriser: Rasteriser
) -> Backdrop:
    """Colour the shell after the training views."""
    total, weights = np.zeros((ROWS * COLUMNS, 3)), np.zeros(ROWS * COLUMNS)
    for view in views:
        target, T = view.half, view.T_base_color
        drawn = rasteriser.view(cloud, target.camera, T)
        part = (slice(None, None, STEP_PX), slice(None, None, STEP_PX))
        static = target.static_mask[part]
        rays = target.camera.rays()[part][static] @ T[:3, :3].T
        places = _places(rays, (ROWS, COLUMNS))
        row = np.clip(np.rint(places[0]).astype(int), 0, ROWS - 1)
        column = (np.rint(places[1]).astype(int) - 1) % COLUMNS
        weight = SEEN_WEIGHT + np.clip(1 - drawn.alpha[part][static], 0.0, 1.0)
        colors = np.moveaxis(target.image(), 0, -1)[part][static]
        np.add.at(total, row * COLUMNS + column, weight[:, None] * colors)
        np.add.at(weights, row * COLUMNS + column, weight)
    colors = _spread(total, weights).reshape(ROWS, COLUMNS, 3)
    return Backdrop(colors=colors.astype(np.float32))


def _spread(
    total: Float[np.ndarray, "num_cells 3"], weights: Float[np.ndarray, " num_cells"]
) -> Float[np.ndarray, "num_cells 3"]:
    """Each cell's colour from all that have one, near ones first."""
    known = np.flatnonzero(weights > 0)
    if not len(known):
        return np.zeros_like(total)
    down = (np.arange(ROWS) + 0.5) / ROWS * np.pi
    heading = ((np.arange(COLUMNS) + 0.5) / COLUMNS - 0.5) * 2 * np.pi
    down, heading = np.meshgrid(down, heading, indexing="ij")
    level = np.sin(down)
    places = np.stack([level * np.cos(heading), level * np.sin(heading), np.cos(down)], axis=-1)
    cells = places.reshape(-1, 3)
    cosines = np.clip(cells @ cells[known].T, -1.0, 1.0)
    nearness = 1 / (np.arccos(cosines) ** 2 + NEAR_RAD**2) ** 2
    # What many images saw says no more of its neighbours than what one saw.
    colors, trust = total[known] / weights[known, None], np.minimum(weights[known], 1.0)
    shares = nearness * trust
    return np.asarray(shares @ colors / shares.sum(axis=1, keepdims=True))


def read_backdrop(run: RunFolder, record: Mapping[str, Any]) -> Backdrop | None:
    """The shell of a scene; None where ``scene.json`` names none, or its picture is gone."""
    path = run.scene_dir / BACKDROP
    if not record.get("backdrop") or not path.is_file():
        return None
    try:
        colors = decode_color(path.read_bytes()).astype(np.float32)
    except UnreadableImageError as error:
        raise UnreadableFileError(path=path, found=error.found) from error
    return Backdrop(colors=colors / np.float32(255.0))
