"""The protocol stamp: nothing without it, and what it makes of several numbers in a row."""

from dataclasses import replace

import pytest

from evaluator.metrics.image_protocol import Stamp, common_text

STAMP = Stamp(
    metric="SSIM",
    implementation="bridge.media.image_quality 1",
    window="gaussian 11 x 11 sigma 1.5",
    padding="zeros",
    resolution="640 x 480",
    alignment="no colour alignment",
    split="every 8th frame",
    stored="stored as png",
    n=12,
)


@pytest.mark.parametrize("name", ["resolution", "split", "alignment", "mask", "stored", "window"])
def test_a_stamp_with_a_blank_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        replace(STAMP, **{name: "  "})


def test_a_row_says_once_what_its_numbers_share() -> None:
    psnr = replace(STAMP, metric="PSNR (dB)", window="none", padding="none", implementation="x 1")
    text = common_text([psnr, STAMP])
    assert text.count("640 x 480") == 1
    assert "SSIM: " in text
    assert "padding zeros" in text
    assert "split every 8th frame" in text
    assert "not stated: split" in common_text([replace(STAMP, split="not stated")])


def test_a_row_without_a_stamp_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one protocol stamp"):
        common_text([])
