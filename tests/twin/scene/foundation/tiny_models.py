"""Tiny networks with random weights, saved as their makers save the real ones."""

from pathlib import Path
from typing import Any

import torch
import transformers
from tokenizers import Tokenizer, models, pre_tokenizers, processors

WORDS = ("red", "cube", "duck", "box", "a", "yellow", "robot", "table")
VOCABULARY = 100
PAD, UNKNOWN, START, END = 0, 1, VOCABULARY - 2, VOCABULARY - 1
MAX_TOKENS = 8


def save_tokenizer(folder: Path) -> None:
    """One number a word, with a first and a last token as CLIP has them."""
    special = {"<pad>": PAD, "<unk>": UNKNOWN, "<s>": START, "</s>": END}
    vocabulary = special | {word: index for index, word in enumerate(WORDS, start=2)}
    words = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    words.post_processor = processors.TemplateProcessing(
        single="<s> $A </s>", special_tokens=[("<s>", START), ("</s>", END)]
    )
    names = {"pad_token": "<pad>", "unk_token": "<unk>", "bos_token": "<s>", "eos_token": "</s>"}
    transformers.PreTrainedTokenizerFast(tokenizer_object=words, **names).save_pretrained(folder)


def _text_config() -> dict[str, Any]:
    return {
        "model_type": "clip_text_model",
        "vocab_size": VOCABULARY,
        "hidden_size": 32,
        "intermediate_size": 64,
        "projection_dim": 32,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "max_position_embeddings": MAX_TOKENS,
        "pad_token_id": PAD,
        "bos_token_id": START,
        "eos_token_id": END,
    }


def save_sam3(folder: Path) -> None:
    torch.manual_seed(0)
    small = {"hidden_size": 32, "intermediate_size": 64, "num_attention_heads": 4}
    config = transformers.Sam3Config(
        vision_config={
            "backbone_config": {
                "model_type": "sam3_vit_model",
                "num_hidden_layers": 2,
                "image_size": 112,
                "pretrain_image_size": 56,
                "patch_size": 14,
                "window_size": 4,
                "global_attn_indexes": [1],
                **small,
            },
            "fpn_hidden_size": 32,
            "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
        },
        text_config=_text_config(),
        geometry_encoder_config={"num_layers": 1, **small},
        detr_encoder_config={"num_layers": 1, **small},
        detr_decoder_config={"num_layers": 1, "num_queries": 10, **small},
        mask_decoder_config={"hidden_size": 32, "num_attention_heads": 4},
    )
    transformers.Sam3Model(config).eval().save_pretrained(folder)
    save_tokenizer(folder)


def save_clip(folder: Path) -> None:
    torch.manual_seed(1)
    vision = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "image_size": 32,
        "patch_size": 8,
    }
    config = transformers.CLIPConfig(
        text_config=_text_config(), vision_config=vision, projection_dim=16
    )
    transformers.CLIPModel(config).eval().save_pretrained(folder)
    save_tokenizer(folder)
