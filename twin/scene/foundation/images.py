"""Images for networks: resized and normalised in torch, without torchvision."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from bridge.errors import MissingDependencyError

Normalisation = tuple[tuple[float, ...], tuple[float, ...]]
"""Mean and standard deviation of red, green, blue, for colours 0..1."""
IMAGENET: Normalisation = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
HALF: Normalisation = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


def import_torch() -> Any:
    """Import torch.

    Raises:
        MissingDependencyError: It is not installed.
    """
    try:
        import torch  # noqa: PLC0415  # only the extra [twin] brings it
    except ImportError as error:
        purpose = "a foundation model"
        raise MissingDependencyError(package="torch", extra="twin", purpose=purpose) from error
    return torch


def network_input(
    images_u8: Sequence[UInt8[np.ndarray, "_ _ 3"]],
    size: tuple[int, int],
    normalisation: Normalisation,
    *,
    mode: str = "bilinear",
) -> Any:
    """Stretch images to one size and normalise them, as one float32 tensor (n, 3, height, width).

    Args:
        images_u8: sRGB images, of any sizes.
        size: Height and width that the network takes.
        normalisation: Mean and standard deviation of each colour.
        mode: ``bilinear`` or ``bicubic``; both low-pass when they shrink.
    """
    torch = import_torch()
    rows = []
    for image in images_u8:
        pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None].float()
        if tuple(pixels.shape[2:]) != size:
            pixels = torch.nn.functional.interpolate(
                pixels, size=size, mode=mode, align_corners=False, antialias=True
            ).clamp(0.0, 255.0)
        rows.append(pixels)
    mean, deviation = (torch.tensor(each).view(1, 3, 1, 1) for each in normalisation)
    return (torch.cat(rows) / 255.0 - mean) / deviation
