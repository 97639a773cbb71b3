"""SAM 3 from a folder that holds a tiny network with random weights."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from model_inputs import picture, sam3

from bridge.errors import UsageError

pytest.importorskip("transformers", reason="the extra [foundation] is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("without_network")]


def test_sam3_gives_masks_of_the_image_s_size_with_scores_from_0_to_1(
    saved: Callable[[str], Path],
) -> None:
    segmenter = sam3(saved("sam3"))
    found = segmenter.segment(picture(), ["red cube", "duck"])
    assert len(found) == 20  # ten queries each
    for mask in found:
        assert mask.image.shape == (60, 80)
        assert mask.image.dtype == np.bool_
        assert 0.0 <= mask.score <= 1.0
    for label in ("red cube", "duck"):
        scores = [mask.score for mask in found if mask.label == label]
        assert scores == sorted(scores, reverse=True)
    assert any(mask.image.any() and not mask.image.all() for mask in found)


def test_sam3_drops_what_is_unlikely_or_small(saved: Callable[[str], Path]) -> None:
    everything = sam3(saved("sam3"))
    masks = everything.segment(picture(), ["duck"])
    cut, least = masks[4].score, sorted(int(mask.image.sum()) for mask in masks)[5]
    likely = sam3(saved("sam3"), min_score=cut)
    assert len(likely.segment(picture(), ["duck"])) == 5
    large = sam3(saved("sam3"), min_pixels=least)
    kept = large.segment(picture(), ["duck"])
    assert 0 < len(kept) < 10
    assert min(int(mask.image.sum()) for mask in kept) >= least


@pytest.mark.parametrize(
    ("prompts", "said"),
    [
        ([], "0 prompts"),
        (["duck"] * 65, "65 prompts"),
        (["  "], "is no prompt"),
        (["duck\n"], "is no prompt"),
        (["a red cube a red cube a"], "has 9 tokens, SAM 3 reads 8"),
    ],
)
def test_sam3_refuses_prompts_it_cannot_read_whole(
    saved: Callable[[str], Path], prompts: list[str], said: str
) -> None:
    segmenter = sam3(saved("sam3"))
    with pytest.raises(UsageError, match=said):
        segmenter.segment(picture(), prompts)


def test_sam3_is_read_in_the_form_it_is_published_in(
    saved: Callable[[str], Path], tmp_path: Path
) -> None:
    """As the detector inside a model for videos, whose other parts are left out."""
    import json

    import torch
    from safetensors.torch import load_file, save_file

    for path in saved("sam3").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    inner = json.loads((tmp_path / "config.json").read_text())
    outer = {"model_type": "sam3_video", "detector_config": inner}
    (tmp_path / "config.json").write_text(json.dumps(outer))
    tensors = load_file(tmp_path / "model.safetensors")
    named = {f"detector_model.{name}": values for name, values in tensors.items()}
    named |= {"tracker_model.a": torch.zeros(3), "tracker_neck.b": torch.zeros(2)}
    save_file(named, tmp_path / "model.safetensors", metadata={"format": "pt"})
    plain, video = (
        sam3(folder).segment(picture(), ["duck"]) for folder in (saved("sam3"), tmp_path)
    )
    for one, other in zip(plain, video, strict=True):
        assert one.score == other.score
        np.testing.assert_array_equal(one.image, other.image)
