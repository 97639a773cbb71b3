"""Adapters of foundation models, opened by ``sam3:FOLDER`` and the like, or a CLIP folder.

SAM 3 (Carion et al. 2025): words in, masks out, by text prompts only, because boxes would need
torchvision's region pooling. DINOv3 (Simeoni et al. 2025): features of every part of an image, from
a ViT. CLIP (Radford et al. 2021): words and pieces of images in one space.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from bridge.errors import UsageError
from twin.naming.things import FeatureMap, Mask, MaskSet
from twin.scene.foundation.loading import (
    HALF,
    IMAGENET,
    Normalisation,
    Placement,
    Tokenizer,
    WeightsKind,
    import_torch,
    load_model,
    network_input,
    read_normalisation,
)

SAM3_KIND = WeightsKind(
    name="SAM 3",
    model_types=("sam3", "sam3_video"),
    origin="facebook/sam3",
    licence="SAM License, access on request",
    speaks=True,
)
MAX_PROMPTS = 64


@dataclass(frozen=True, kw_only=True)
class Sam3Config:
    """What counts as a mask."""

    min_score: float = 0.5
    """Masks with less are dropped. A score is the product of "this region is one" and "the image
    holds one"."""
    mask_threshold: float = 0.5
    """Probability above which a pixel belongs to a mask."""
    min_pixels: int = 16
    """Smaller masks are dropped."""


class Sam3Segmenter:
    """Finds everything that fits a few words, in one image at a time."""

    source = "SAM 3"

    def __init__(self, model: Any, tokenizer: Tokenizer, folder: Path, config: Sam3Config) -> None:
        """Take loaded parts; ``load`` is the way in."""
        self.config = config
        self._model = model
        self._tokenizer = tokenizer
        self._normalisation = read_normalisation(folder, SAM3_KIND, HALF)
        side = model.config.vision_config.image_size
        self._size = (side, side) if isinstance(side, int) else (side[0], side[1])

    @staticmethod
    def load(
        folder: Path, placement: Placement | None = None, config: Sam3Config | None = None
    ) -> "Sam3Segmenter":
        """Load weights from a local folder."""
        model = load_model(folder, SAM3_KIND, "Sam3Model", placement or Placement())
        tokenizer = Tokenizer(folder, SAM3_KIND, model.config.text_config.max_position_embeddings)
        return Sam3Segmenter(model, tokenizer, folder, config or Sam3Config())

    def segment(
        self,
        image_u8: UInt8[np.ndarray, "height width 3"],
        prompts: Sequence[str],
        *,
        camera_id: str,
        stamp_ns: int,
    ) -> MaskSet:
        """Find what the prompts name.

        The image is looked at once, however many prompts there are. Masks of different prompts may
        overlap.

        Args:
            prompts: A few words each; they become the labels.
        """
        if not 0 < len(prompts) <= MAX_PROMPTS:
            message = f"{len(prompts)} prompts; SAM 3 takes 1 to {MAX_PROMPTS} of them."
            raise UsageError(message)
        torch = import_torch()
        ids, attention = self._tokenizer(prompts)
        parameter = next(self._model.parameters())
        pixels = network_input([image_u8], self._size, self._normalisation)
        masks: list[Mask] = []
        with torch.inference_mode():
            seen = self._model.get_vision_features(
                pixel_values=pixels.to(parameter.device, parameter.dtype)
            )
            for row, prompt in enumerate(prompts):
                found = self._model(
                    vision_embeds=seen,
                    input_ids=ids[row : row + 1].to(parameter.device),
                    attention_mask=attention[row : row + 1].to(parameter.device),
                )
                masks += self._masks(found, prompt, image_u8.shape[:2])
        return MaskSet(camera_id=camera_id, stamp_ns=stamp_ns, masks=masks, source=self.source)

    def _masks(self, found: Any, prompt: str, size: tuple[int, ...]) -> list[Mask]:
        torch = import_torch()
        scores = found.pred_logits[0].float().sigmoid()
        presence = getattr(found, "presence_logits", None)
        if presence is not None:
            scores = scores * presence[0].float().sigmoid()
        order = torch.argsort(scores, descending=True, stable=True)
        order = order[scores[order] >= self.config.min_score]
        masks = []
        for index in order.tolist():  # one by one: 200 masks of a whole image would fill the memory
            probability = found.pred_masks[0, index][None, None].float().sigmoid()
            probability = torch.nn.functional.interpolate(
                probability, size=tuple(size), mode="bilinear", align_corners=False
            )
            image = (probability[0, 0] > self.config.mask_threshold).cpu().numpy()
            if int(image.sum()) >= self.config.min_pixels:
                masks.append(Mask(image=image, label=prompt, score=float(scores[index])))
        return masks


DINOV3_KIND = WeightsKind(
    name="DINOv3",
    model_types=("dinov3_vit",),
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
        self._normalisation = read_normalisation(folder, DINOV3_KIND, IMAGENET)
        config = model.config
        self.cell_px = int(config.patch_size)
        self.num_channels = int(config.hidden_size)
        self._num_first = 1 + int(config.num_register_tokens)

    @staticmethod
    def load(folder: Path, placement: Placement | None = None) -> "DinoFeatures":
        """Load weights from a local folder."""
        model = load_model(folder, DINOV3_KIND, "DINOv3ViTModel", placement or Placement())
        return DinoFeatures(model, folder)

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
            stride: Image pixels per cell; None: the network's own.
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


CLIP_KIND = WeightsKind(
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
        self._normalisation = read_normalisation(folder, CLIP_KIND, CLIP_COLOURS)
        self._side = int(model.config.vision_config.image_size)
        self.num_channels = int(model.config.projection_dim)

    @staticmethod
    def load(folder: Path, placement: Placement | None = None) -> "ClipEmbedder":
        """Load weights from a local folder."""
        model = load_model(folder, CLIP_KIND, "CLIPModel", placement or Placement())
        tokenizer = Tokenizer(folder, CLIP_KIND, model.config.text_config.max_position_embeddings)
        return ClipEmbedder(model, tokenizer, folder)

    def encode(self, texts: Sequence[str]) -> Float32[np.ndarray, "num_texts num_channels"]:
        """Unit vectors of words."""
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
            masks: Of the same sizes, none empty.
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

    Args:
        ground_u8: sRGB of everything around it.
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


SEGMENTERS = ("sam3",)
FEATURES = ("dinov3",)


def split_spec(spec: str, option: str, known: tuple[str, ...]) -> tuple[str, Path]:
    """Split ``name:folder``.

    Args:
        spec: As the user wrote it; ``~`` is expanded in the folder.
    """
    name, colon, folder = spec.partition(":")
    if name not in known or not colon or not folder:
        forms = ", ".join(f"{each}:FOLDER" for each in known)
        message = f"{option} {spec!r} is not understood; write {forms}."
        raise UsageError(message)
    return name, Path(folder).expanduser()
