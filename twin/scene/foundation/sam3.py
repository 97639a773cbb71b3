"""SAM 3: words in, masks out (Carion et al. 2025), by text prompts only.

Boxes as prompts would need torchvision's region pooling, which we do not ask for.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from bridge.errors import UsageError
from twin.scene.foundation.images import HALF, import_torch, network_input
from twin.scene.foundation.loading import Placement, Tokenizer, load_model
from twin.scene.foundation.weights import WeightsKind, read_normalisation
from twin.scene.semantics.result import Mask, MaskSet

KIND = WeightsKind(
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
        self._normalisation = read_normalisation(folder, KIND, HALF)
        side = model.config.vision_config.image_size
        self._size = (side, side) if isinstance(side, int) else (side[0], side[1])

    @staticmethod
    def load(
        folder: Path, placement: Placement | None = None, config: Sam3Config | None = None
    ) -> "Sam3Segmenter":
        """Load weights from a local folder.

        Raises:
            WeightsError: When the folder is missing, incomplete or of another kind.
            MissingDependencyError: When the extra ``foundation`` is not installed.
        """
        model = load_model(folder, KIND, "Sam3Model", placement or Placement())
        tokenizer = Tokenizer(folder, KIND, model.config.text_config.max_position_embeddings)
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
            image_u8: sRGB.
            prompts: A few words each; they become the labels.
            camera_id: For the result.
            stamp_ns: For the result.

        Raises:
            UsageError: When there are no prompts, too many, or one that cannot be read.
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
