"""DINOv3: features of every part of an image (Simeoni et al. 2025), from a ViT or a ConvNeXt."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from bridge.errors import UsageError
from twin.scene.foundation.images import IMAGENET, import_torch, network_input
from twin.scene.foundation.loading import Placement, load_model
from twin.scene.foundation.weights import WeightsKind, check_folder, read_normalisation
from twin.scene.semantics.result import FeatureMap

VIT, CONVNEXT = "dinov3_vit", "dinov3_convnext"
KIND = WeightsKind(
    name="DINOv3",
    model_types=(VIT, CONVNEXT),
    origin="facebook/dinov3-vits16-pretrain-lvd1689m or a larger one",
    licence="DINOv3 License, access on request",
)
MAX_CELLS = 16_384
"""Cells of one feature map; attention grows with their square."""


class DinoFeatures:
    """Turns images into feature maps."""

    source = "DINOv3"

    def __init__(self, model: Any, folder: Path) -> None:
        """Take a loaded network; ``load`` is the way in."""
        self._model = model
        self._normalisation = read_normalisation(folder, KIND, IMAGENET)
        config = model.config
        if config.model_type == CONVNEXT:
            self.cell_px = 4 * 2 ** (len(config.hidden_sizes) - 1)
            self.num_channels = int(config.hidden_sizes[-1])
            self._num_first = 1  # the pooled token
        else:
            self.cell_px = int(config.patch_size)
            self.num_channels = int(config.hidden_size)
            self._num_first = 1 + int(config.num_register_tokens)

    @staticmethod
    def load(folder: Path, placement: Placement | None = None) -> "DinoFeatures":
        """Load weights from a local folder.

        Raises:
            WeightsError: When the folder is missing, incomplete or of another kind.
            MissingDependencyError: When the extra ``foundation`` is not installed.
        """
        config = check_folder(folder, KIND)
        is_vit = config["model_type"] == VIT
        name = "DINOv3ViTModel" if is_vit else "DINOv3ConvNextModel"
        return DinoFeatures(load_model(folder, KIND, name, placement or Placement()), folder)

    def features(
        self,
        images_u8: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        *,
        stride: int | None = None,
    ) -> list[FeatureMap]:
        """Compute one map for each image; images of one size go through the network together.

        Cell (i, j) lies over the ``stride`` image rows from ``i * stride`` on and the columns from
        ``j * stride`` on; where the last cells reach over the edge, the edge is repeated. A stride
        below the network's own enlarges the image first.

        Args:
            images_u8: sRGB images of one size.
            stride: Image pixels per cell; None: the network's own (16 of a ViT, 32 of a ConvNeXt).

        Raises:
            UsageError: When sizes differ, or the maps would be empty or too large.
        """
        if not images_u8:
            return []
        height, width = images_u8[0].shape[:2]
        if any(image.shape[:2] != (height, width) for image in images_u8):
            message = (
                "images of different sizes cannot be looked at together; pass one size a call."
            )
            raise UsageError(message)
        step = self.cell_px if stride is None else stride
        fits = 0 < step <= min(height, width)
        rows, columns = (-(-side // step) if fits else 0 for side in (height, width))
        if not 0 < rows * columns <= MAX_CELLS:
            message = (
                f"an image of {width} x {height} pixels with stride {step} gives "
                f"{rows * columns} cells; between 1 and {MAX_CELLS} are possible."
            )
            raise UsageError(message)
        size = (rows * self.cell_px, columns * self.cell_px)
        over = ((0, rows * step - height), (0, columns * step - width), (0, 0))
        whole = [np.pad(image, over, mode="edge") for image in images_u8]
        pixels = network_input(whole, size, self._normalisation, mode="bicubic")
        values = self._run(pixels).reshape(len(images_u8), rows, columns, self.num_channels)
        maps = np.ascontiguousarray(np.moveaxis(values, -1, 1))
        return [FeatureMap(values=item, stride=step) for item in maps]

    def _run(self, pixels: Any) -> np.ndarray:
        parameter = next(self._model.parameters())
        with import_torch().inference_mode():
            found = self._model(pixel_values=pixels.to(parameter.device, parameter.dtype))
        tokens = found.last_hidden_state[:, self._num_first :]
        result: np.ndarray = tokens.float().cpu().numpy()
        return result
