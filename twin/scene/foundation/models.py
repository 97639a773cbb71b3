"""Adapters of foundation models, opened by ``sam3:FOLDER`` or a folder of CLIP.

SAM 3 (Carion et al. 2025): words in, masks out, by text prompts only, because boxes would need
torchvision's region pooling. CLIP (Radford et al. 2021): words and pieces of images in one space.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from bridge.errors import UsageError
from twin.naming.things import Mask
from twin.scene.foundation.loading import Network, WeightsKind
from twin.scene.raster.backend import import_torch

MAX_PROMPTS = 64
MARGIN_FRACTION = 0.1
"""A crop is this much larger than the mask on each side: a little context helps."""


class Sam3Segmenter(Network):
    """Finds everything that fits a few words, in one image at a time."""

    kind = WeightsKind(
        name="SAM 3",
        model_types=("sam3", "sam3_video"),
        class_name="Sam3Model",
        colours=((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
        origin="facebook/sam3",
        licence="SAM License, access on request",
    )
    min_score = 0.5
    """Masks with less are dropped. A score is the product of "this region is one" and "the image
    holds one"."""
    mask_threshold = 0.5
    """Probability above which a pixel belongs to a mask."""
    min_pixels = 16
    """Smaller masks are dropped."""

    def segment(
        self, image_u8: UInt8[np.ndarray, "height width 3"], prompts: Sequence[str]
    ) -> list[Mask]:
        """Find what the prompts name; they become the labels.

        The image is looked at once, however many prompts there are. Masks of different prompts may
        overlap.
        """
        if not 0 < len(prompts) <= MAX_PROMPTS:
            message = f"{len(prompts)} prompts; SAM 3 takes 1 to {MAX_PROMPTS} of them."
            raise UsageError(message)
        ids, attention = self._tokens(prompts)
        side = self._model.config.vision_config.image_size
        size = (side, side) if isinstance(side, int) else (side[0], side[1])
        masks: list[Mask] = []
        with import_torch().inference_mode():
            seen = self._model.get_vision_features(pixel_values=self._pixels([image_u8], size))
            for row, prompt in enumerate(prompts):
                found = self._model(
                    vision_embeds=seen,
                    input_ids=ids[row : row + 1],
                    attention_mask=attention[row : row + 1],
                )
                masks += self._masks(found, prompt, image_u8.shape[:2])
        return masks

    def _masks(self, found: Any, prompt: str, size: tuple[int, ...]) -> list[Mask]:
        torch = import_torch()
        scores = found.pred_logits[0].float().sigmoid()
        presence = getattr(found, "presence_logits", None)
        if presence is not None:
            scores = scores * presence[0].float().sigmoid()
        order = torch.argsort(scores, descending=True, stable=True)
        order = order[scores[order] >= self.min_score]
        masks = []
        for index in order.tolist():  # one by one: 200 masks of a whole image would fill the memory
            probability = found.pred_masks[0, index][None, None].float().sigmoid()
            probability = torch.nn.functional.interpolate(
                probability, size=tuple(size), mode="bilinear", align_corners=False
            )
            image = (probability[0, 0] > self.mask_threshold).cpu().numpy()
            if int(image.sum()) >= self.min_pixels:
                masks.append(Mask(image=image, label=prompt, score=float(scores[index])))
        return masks


class ClipEmbedder(Network):
    """Unit vectors of words and of masked pieces of images; their dot product is the likeness."""

    kind = WeightsKind(
        name="CLIP",
        model_types=("clip",),
        class_name="CLIPModel",
        colours=((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)),
        origin="openai/clip-vit-base-patch16 or a larger one",
        licence="MIT",
    )

    @property
    def num_channels(self) -> int:
        """Length of its vectors."""
        return int(self._model.config.projection_dim)

    def encode(self, texts: Sequence[str]) -> Float32[np.ndarray, "num_texts num_channels"]:
        """Unit vectors of words."""
        ids, attention = self._tokens(texts)
        with import_torch().inference_mode():
            return _unit(self._model.get_text_features(input_ids=ids, attention_mask=attention))

    def embed_masked(
        self,
        images_u8: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        masks: Sequence[Bool[np.ndarray, "_ _"]],
    ) -> Float32[np.ndarray, "num_masks num_channels"]:
        """Unit vectors of what the masks cut out, each cropped to its square on a neutral ground.

        Args:
            masks: Of the same sizes, none empty; at least one.
        """
        ground = np.rint(np.array(self._normalisation[0]) * 255.0).astype(np.uint8)
        pairs = zip(images_u8, masks, strict=True)
        crops = [masked_crop(image, mask, ground) for image, mask in pairs]
        side = int(self._model.config.vision_config.image_size)
        pixels = self._pixels(crops, (side, side), "bicubic")
        with import_torch().inference_mode():
            return _unit(self._model.get_image_features(pixel_values=pixels))


def masked_crop(
    image_u8: UInt8[np.ndarray, "_ _ 3"],
    mask: Bool[np.ndarray, "_ _"],
    ground_u8: UInt8[np.ndarray, "3"],
) -> UInt8[np.ndarray, "side side 3"]:
    """The square around a mask with a margin; all but the mask has the ground's colour.

    Args:
        ground_u8: sRGB of everything around it.
    """
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


def sam3_folder(spec: str) -> Path:
    """The folder in ``sam3:FOLDER``, as the user wrote it."""
    name, colon, folder = spec.partition(":")
    if name != "sam3" or not colon or not folder:
        message = f"--segmenter {spec!r} is not understood; write sam3:FOLDER."
        raise UsageError(message)
    return Path(folder).expanduser()
