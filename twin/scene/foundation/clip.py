"""CLIP: words and pieces of images in one space (Radford et al. 2021)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from bridge.errors import UsageError
from twin.scene.foundation.images import Normalisation, import_torch, network_input
from twin.scene.foundation.loading import Placement, Tokenizer, load_model
from twin.scene.foundation.weights import WeightsKind, read_normalisation

KIND = WeightsKind(
    name="CLIP",
    model_types=("clip",),
    origin="openai/clip-vit-base-patch16 or a larger one",
    licence="MIT",
    speaks=True,
)
CLIP_COLOURS: Normalisation = (
    (0.48145466, 0.4578275, 0.40821073),
    (0.26862954, 0.26130258, 0.27577711),
)
MARGIN_FRACTION = 0.1
"""A crop is this much larger than the mask on each side: a little context helps."""


class ClipEmbedder:
    """Unit vectors of words and of masked pieces of images; their dot product is the likeness."""

    source = "CLIP"

    def __init__(self, model: Any, tokenizer: Tokenizer, folder: Path) -> None:
        """Take loaded parts; ``load`` is the way in."""
        self._model = model
        self._tokenizer = tokenizer
        self._normalisation = read_normalisation(folder, KIND, CLIP_COLOURS)
        self._side = int(model.config.vision_config.image_size)
        self.num_channels = int(model.config.projection_dim)
        self.temperature = float(1.0 / model.logit_scale.detach().exp().clamp(1.0, 100.0))
        """What to divide likenesses by before a softmax, as learnt."""

    @staticmethod
    def load(folder: Path, placement: Placement | None = None) -> "ClipEmbedder":
        """Load weights from a local folder.

        Raises:
            WeightsError: When the folder is missing, incomplete or of another kind.
            MissingDependencyError: When the extra ``foundation`` is not installed.
        """
        model = load_model(folder, KIND, "CLIPModel", placement or Placement())
        tokenizer = Tokenizer(folder, KIND, model.config.text_config.max_position_embeddings)
        return ClipEmbedder(model, tokenizer, folder)

    def encode(self, texts: Sequence[str]) -> Float32[np.ndarray, "num_texts num_channels"]:
        """Unit vectors of words.

        Raises:
            UsageError: For an empty text or one that is too long.
        """
        if not texts:
            return np.zeros((0, self.num_channels), dtype=np.float32)
        ids, attention = self._tokenizer(texts)
        device = next(self._model.parameters()).device
        with import_torch().inference_mode():
            found = self._model.get_text_features(
                input_ids=ids.to(device), attention_mask=attention.to(device)
            )
        return _unit(found)

    def embed_masked(
        self,
        images_u8: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        masks: Sequence[Bool[np.ndarray, "_ _"]],
    ) -> Float32[np.ndarray, "num_masks num_channels"]:
        """Unit vectors of what the masks cut out, each cropped to its square on a neutral ground.

        Args:
            images_u8: The image of each mask.
            masks: Of the same sizes, none empty.

        Raises:
            UsageError: When an image and its mask do not fit, or a mask is empty.
        """
        if len(images_u8) != len(masks):
            message = f"{len(images_u8)} images for {len(masks)} masks; give each mask its image."
            raise UsageError(message)
        if not masks:
            return np.zeros((0, self.num_channels), dtype=np.float32)
        ground = np.rint(np.array(self._normalisation[0]) * 255.0).astype(np.uint8)
        crops = [
            masked_crop(image, mask, ground) for image, mask in zip(images_u8, masks, strict=True)
        ]
        size = (self._side, self._side)
        pixels = network_input(crops, size, self._normalisation, mode="bicubic")
        parameter = next(self._model.parameters())
        with import_torch().inference_mode():
            found = self._model.get_image_features(
                pixel_values=pixels.to(parameter.device, parameter.dtype)
            )
        return _unit(found)


def masked_crop(
    image_u8: UInt8[np.ndarray, "_ _ 3"],
    mask: Bool[np.ndarray, "_ _"],
    ground_u8: UInt8[np.ndarray, "3"],
) -> UInt8[np.ndarray, "side side 3"]:
    """The square around a mask with a margin; all but the mask has the ground's colour.

    Raises:
        UsageError: When the sizes differ or the mask is empty.
    """
    if image_u8.shape[:2] != mask.shape or not mask.any():
        message = (
            f"a mask of {mask.shape[1]} x {mask.shape[0]} pixels with {int(mask.sum())} set does "
            f"not cut anything out of an image of {image_u8.shape[1]} x {image_u8.shape[0]}."
        )
        raise UsageError(message)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, left = int(rows[0]), int(columns[0])
    height, width = int(rows[-1]) - top + 1, int(columns[-1]) - left + 1
    side = max(1, round(max(height, width) * (1.0 + 2.0 * MARGIN_FRACTION)))
    crop = np.empty((side, side, 3), dtype=np.uint8)
    crop[:] = ground_u8
    y, x = (side - height) // 2, (side - width) // 2
    piece = crop[y : y + height, x : x + width]
    inside = mask[top : top + height, left : left + width]
    piece[inside] = image_u8[top : top + height, left : left + width][inside]
    return crop


def _unit(found: Any) -> np.ndarray:
    vectors = getattr(found, "pooler_output", found)  # version 4 gave the vectors themselves
    values = vectors.float().cpu().numpy()
    return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True), dtype=np.float32)
