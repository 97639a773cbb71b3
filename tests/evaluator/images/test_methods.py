"""Several methods on the same views: what is compared, what is left out, and what is said."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from bridge.errors import PathNotFoundError, UsageError
from evaluator.cli import evaluate
from evaluator.compare.images.methods import compare_folders
from evaluator.compare.rows import Comparison
from evaluator.errors import EvaluatorError
from evaluator.metrics.image_options import ImageOptions

SIZE = (48, 64)


def picture(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    blocks = np.random.default_rng(seed).integers(20, 235, (size[0] // 8, size[1] // 8, 3))
    return np.kron(blocks, np.ones((8, 8, 1))).astype(np.uint8)


def noisy(image: np.ndarray, scale: float) -> np.ndarray:
    noise = np.random.default_rng(1).normal(scale=scale, size=image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def save(image: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """``recorded`` and the methods ``good`` and ``poor``, three views each."""
    for index in range(3):
        recorded = picture(index)
        save(recorded, tmp_path / "recorded" / f"{index:04}.png")
        save(noisy(recorded, 4), tmp_path / "good" / f"{index:04}.png")
        save(noisy(recorded, 20), tmp_path / "poor" / f"{index:04}.png")
    return tmp_path


def compared(folders: Path, **changes: object) -> Comparison:
    options = {
        "reference": folders / "recorded",
        "renders": (f"good={folders / 'good'}", f"poor={folders / 'poor'}"),
        **changes,
    }
    return compare_folders(ImageOptions(**options))  # type: ignore[arg-type]


def reasons(comparison: Comparison) -> dict[str, str]:
    return {e.episode: e.reason for e in comparison.exclusions if e.scope == "images"}


def test_each_method_has_its_means_over_the_same_views(folders: Path) -> None:
    results = compared(folders, split="every 8th frame").results()
    psnr = results.get("image.good.psnr_db")
    by_hand = [
        peak_signal_noise_ratio(picture(i), noisy(picture(i), 4), data_range=255) for i in range(3)
    ]
    assert psnr.value == pytest.approx(np.mean(by_hand), abs=1e-9)
    assert psnr.n == 3
    for words in (
        "64 x 48",
        "every 8th frame",
        "no colour alignment",
        "stored as png",
        "full frame",
    ):
        assert words in psnr.definition
    assert results.get("image.poor.psnr_db").value < psnr.value
    assert results.get("image.good.ssim_zero").value > results.get("image.poor.ssim_zero").value
    results.to_record()  # fits the schema


def test_the_headline_is_laid_out_as_the_paper_s_with_the_protocol_in_each_row(
    folders: Path,
) -> None:
    table = {table.id: table for table in compared(folders).tables}["image_methods"]
    assert table.columns == ("method", "PSNR (dB)", "SSIM", "LPIPS (vgg)", "views", "protocol")
    assert [row[0] for row in table.rows] == ["good", "poor"]
    assert {row[3] for row in table.rows} == {"not computed"}
    assert all("not stated: split" in str(row[-1]) for row in table.rows)
    assert all("64 x 48" in str(row[-1]) for row in table.rows)


def test_lpips_is_not_computed_without_a_backbone_and_says_so(folders: Path) -> None:
    comparison = compared(folders)
    assert not any("lpips" in m.id for m in comparison.measurements)
    assert any("no backbone" in text for text in comparison.missing)


def break_views(folders: Path) -> dict[str, Callable[[], object]]:
    """Ways to spoil the view 0001 of the method ``good``."""
    path = folders / "good" / "0001.png"
    image = noisy(picture(1), 4)

    def sixteen_bits() -> None:
        path.write_bytes(rgb16_png(image))

    return {
        "no image of this name": path.unlink,
        r"\(40, 64, 3\)": lambda: save(image[:40], path),
        "red and blue look swapped": lambda: save(image[..., ::-1], path),
        "is grey": lambda: save(image[..., 0], path),
        "transparency": lambda: save(np.dstack([image, image[..., 0]]), path),
        "16 bits for each channel": sixteen_bits,
        "cannot be read": lambda: path.write_bytes(path.read_bytes()[:200]),
        "neither PNG nor JPEG": lambda: path.write_bytes(b"GIF89a"),
    }


def rgb16_png(image: np.ndarray) -> bytes:
    """A 16-bit colour PNG, which Pillow cannot write."""
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        checked = kind + data
        return struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))

    height, width, _ = image.shape
    wide = (image.astype(">u2") * 257).reshape(height, -1)
    rows = b"".join(b"\0" + row.tobytes() for row in wide)
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


WAYS = tuple(break_views(Path("nowhere")))


@pytest.mark.parametrize("words", WAYS)
def test_a_broken_view_is_named_and_counts_for_no_method(folders: Path, words: str) -> None:
    import re

    break_views(folders)[words]()
    comparison = compared(folders)
    left_out = reasons(comparison)
    assert re.search(words, left_out["good: 0001"]), left_out
    assert "left out for every method: no score of good" in left_out["0001"]
    assert {comparison.results().get(f"image.{m}.psnr_db").n for m in ("good", "poor")} == {2}


def test_an_opaque_alpha_channel_and_jpeg_are_read(folders: Path) -> None:
    opaque = np.dstack([noisy(picture(1), 4), np.full(SIZE, 255, dtype=np.uint8)])
    save(opaque, folders / "good" / "0001.png")
    (folders / "good" / "0002.png").unlink()
    save(noisy(picture(2), 4), folders / "good" / "0002.jpg")
    comparison = compared(folders)
    assert not comparison.exclusions
    psnr = comparison.results().get("image.good.psnr_db")
    assert psnr.n == 3
    assert "stored as jpg, png" in psnr.definition


def test_images_the_reference_does_not_have_are_named(folders: Path) -> None:
    save(picture(7), folders / "poor" / "train" / "0007.png")
    assert "the reference has no such image" in reasons(compared(folders))["poor: train/0007"]


def test_a_method_with_all_channels_swapped_is_refused_with_the_reason(folders: Path) -> None:
    for path in sorted((folders / "poor").iterdir()):
        save(np.asarray(Image.open(path))[..., ::-1], path)
    with pytest.raises(EvaluatorError, match=r"poor: 0002: red and blue look swapped.*leave out"):
        compared(folders)


def test_nothing_in_common_is_an_error_that_shows_both_namings(folders: Path) -> None:
    for path in sorted((folders / "good").iterdir()):
        path.rename(path.with_name(f"frame_{path.name}"))
    with pytest.raises(EvaluatorError, match=r"0000.*frame_0000.*Name renders as"):
        compared(folders, renders=(f"good={folders / 'good'}",))


def test_wrong_use_is_told_apart(folders: Path) -> None:
    with pytest.raises(PathNotFoundError, match="folder of images"):
        compared(folders, reference=folders / "nowhere")
    (folders / "empty").mkdir()
    with pytest.raises(EvaluatorError, match="holds no image"):
        compared(folders, reference=folders / "empty")
    with pytest.raises(UsageError, match="two methods called"):
        compared(folders, renders=(f"a={folders / 'good'}", f"a={folders / 'poor'}"))
    with pytest.raises(UsageError, match="cannot tell"):
        compared(folders, renders=(f"a b={folders / 'good'}", f"a_b={folders / 'poor'}"))
    with pytest.raises(UsageError, match="METHOD=FOLDER"):
        compared(folders, renders=("=x",))
    with pytest.raises(UsageError, match="--reference"):
        evaluate(images=ImageOptions(renders=(f"a={folders / 'good'}",)))
    save(picture(1), folders / "good" / "0001.jpg")
    with pytest.raises(EvaluatorError, match=r"has 0001.jpg and 0001.png; keep one"):
        compared(folders)


@pytest.mark.slow
def test_the_command_writes_a_report_of_images_alone(folders: Path) -> None:
    out = folders / "out"
    options = ImageOptions(
        reference=folders / "recorded", renders=(str(folders / "good"), str(folders / "poor"))
    )
    assert evaluate(images=options, out=out) == 0
    record = json.loads((out / "results.json").read_text())
    assert record["source"] == "images"
    assert (out / "report.html").is_file()
    assert "image_methods" in {table["id"] for table in record["tables"]}
    assert evaluate(images=options, out=out, fail_under="image.good.psnr_db=99") == 3


def test_views_of_a_run_may_be_called_as_export_tum_calls_them() -> None:
    from evaluator.compare.images.methods import other_names

    names = other_names(["wrist/1500000000", "side/1500000000", "side/2000000001"])
    assert names["wrist_1500000000"] == "wrist/1500000000"
    assert names["side/rgb/1.500000000"] == "side/1500000000"
    assert names["rgb/2.000000001"] == "side/2000000001"
    assert "1.500000000" not in names  # two cameras have it
