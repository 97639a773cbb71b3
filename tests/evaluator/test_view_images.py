"""Held-out views: each measure against an independent calculation, and each view scored once."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, DepthImage
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.media.image_quality import ImageShapeError, aligned
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare import Comparison, compare_run
from evaluator.compare.images import views
from evaluator.compare.images.scores import ViewScore
from evaluator.errors import EvaluatorError, UndefinedStatisticError
from evaluator.metrics.image import score_depth, score_pair
from evaluator.metrics.image_options import ImageOptions
from evaluator.result import write_results

STAMP = 5_000
SIZE = (36, 44)


def png(image_u8: np.ndarray) -> bytes:
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image_u8).save(buffer, format="png")
    return buffer.getvalue()


def pair(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A recorded image, and the same darker, with noise."""
    rng = np.random.default_rng(seed)
    recorded = rng.integers(40, 250, (*SIZE, 3)).astype(np.float64)
    rendered = 0.8 * recorded + rng.normal(0, 4, recorded.shape)
    return recorded.astype(np.uint8), np.clip(rendered, 0, 255).astype(np.uint8)


def test_a_gain_is_the_least_squares_solution_of_each_channel() -> None:
    recorded, rendered = pair()
    found = aligned(recorded, rendered, "gain")
    for channel in range(3):
        a, b = (image[..., channel].ravel() / 255.0 for image in (rendered, recorded))
        (gain,), *_ = np.linalg.lstsq(a[:, None], b, rcond=None)
        np.testing.assert_allclose(found[..., channel].ravel(), np.clip(gain * a, 0, 1), atol=1e-12)


def test_alignment_helps_against_exposure_and_never_happens_unasked() -> None:
    recorded, rendered = pair()
    raw, gain = (score_pair(recorded, rendered)[how].values["psnr_db"] for how in ("raw", "gain"))
    assert raw == pytest.approx(
        peak_signal_noise_ratio(recorded / 255.0, rendered / 255.0, data_range=1.0), abs=1e-9
    )
    assert gain > raw + 6


def test_depth_errors_are_those_of_pixels_that_both_have() -> None:
    recorded = np.array([[1.0, 0.0, 2.0, 3.0]])
    rendered = np.array([[1.1, 5.0, 0.0, 2.8]])
    score = score_depth(recorded, rendered)
    assert score.mean_abs_m == score.median_abs_m == pytest.approx(0.15)
    edge = score_depth(np.array([[1.0, 1.0, 1.0]]), np.array([[1.01, 1.02, 3.0]]))
    assert edge.median_abs_m == pytest.approx(0.02)
    assert edge.mean_abs_m == pytest.approx(2.03 / 3)
    with pytest.raises(UndefinedStatisticError, match="no pixel"):
        score_depth(recorded, np.zeros_like(recorded))
    with pytest.raises(ImageShapeError):
        score_depth(recorded, rendered.T)


def write_views(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    recorded, rendered = pair()
    mask = np.zeros(SIZE, dtype=bool)
    mask[10:30, 12:40] = True
    with EpisodeWriter(folder / "scan.views.x.mcap") as writer:
        writer.describe(
            EpisodeInfo(id="scan-views-x", kind="scan"),
            derived=Derived(
                kind="views",
                source_episode="scan",
                source_sha256="",
                settings={"holdout": "every 8th frame", "num_splats": 1234},
            ),
        )
        white = np.repeat(mask[..., None], 3, axis=2).astype(np.uint8) * 255
        images = {"recorded/image": recorded, "rendered/image": rendered, "mask/objects": white}
        for tail, image in images.items():
            color = CompressedColor(stamp_ns=STAMP, frame_id="c", format="png", data=png(image))
            writer.write(
                f"/room/views/cam/wrist/{tail}",
                color.to_cdr(),
                type_name=schema.COMPRESSED_IMAGE,
                log_time_ns=STAMP,
            )
        for tail, depth_mm in (("recorded/depth_in_color", 1000), ("rendered/depth", 1010)):
            depth = DepthImage(
                stamp_ns=STAMP, frame_id="c", depth_mm=np.full(SIZE, depth_mm, dtype=np.uint16)
            )
            writer.write(
                f"/room/views/cam/wrist/{tail}",
                depth.to_cdr(),
                type_name=schema.IMAGE,
                log_time_ns=STAMP,
            )
    return recorded, rendered, mask


def test_every_variant_of_a_view_is_measured_and_named(maker: Any) -> None:
    maker.run.derived_dir.mkdir(parents=True, exist_ok=True)
    recorded, rendered, mask = write_views(maker.run.derived_dir)
    results = compare_run(maker.run).results()
    raw = results.get("views.all.psnr_db")
    assert "no colour alignment" in raw.definition
    assert "split every 8th frame; stored lossless" in raw.definition
    assert "one gain per image and channel" in results.get("views.all.psnr_gain_db").definition
    objects = results.get("views.all.psnr_objects_db")
    difference = (recorded[mask] / 255.0 - rendered[mask] / 255.0) ** 2
    assert objects.value == pytest.approx(-10 * np.log10(difference.mean()), abs=1e-9)
    assert "mask 'objects'" in objects.definition
    assert results.get("views.all.depth_mean_abs_m").value == pytest.approx(0.01)
    assert results.get("views.all.depth_median_abs_m").value == pytest.approx(0.01)
    (table,) = (t for t in results.tables if t.id == "views_0")
    row = dict(zip(table.columns, table.rows[0], strict=True))
    assert row["depth (mm)"] == 10.0
    assert row["PSNR gain (dB)"] > row["PSNR (dB)"]


def test_other_methods_stand_beside_the_twin_on_the_views_of_a_run(
    maker: Any, tmp_path: Path
) -> None:
    maker.run.derived_dir.mkdir(parents=True, exist_ok=True)
    recorded, _, _ = write_views(maker.run.derived_dir)
    other = np.clip(recorded.astype(int) + 3, 0, 255).astype(np.uint8)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / f"wrist_{STAMP}.png").write_bytes(png(other))
    options = ImageOptions(renders=(f"other={tmp_path / 'other'}",))
    results = compare_run(maker.run, images=options).results()
    results.to_record()
    found = {m: results.get(f"image.{m}.psnr_db") for m in ("twin", "other")}
    assert found["twin"].value == results.get("views.all.psnr_db").value
    assert found["other"].value > found["twin"].value
    assert "every 8th frame" in found["other"].definition
    table = next(t for t in results.tables if t.id == "image_methods")
    assert [row[0] for row in table.rows] == ["twin", "other"]


def test_a_run_without_views_cannot_be_compared_with(maker: Any, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "0.png").write_bytes(png(pair()[0]))
    options = ImageOptions(renders=(f"other={tmp_path / 'other'}",))
    with pytest.raises(EvaluatorError, match="no rendered views to compare others with"):
        compare_run(maker.run, images=options)
    with pytest.raises(UsageError, match="belong to --renders"):
        compare_run(maker.run, images=ImageOptions(split="every 8th frame"))


def test_every_number_about_views_has_its_stamp(maker: Any) -> None:
    maker.run.derived_dir.mkdir(parents=True, exist_ok=True)
    write_views(maker.run.derived_dir)
    results = compare_run(maker.run).results()
    numbers = [m for m in results.measurements if m.id.startswith("views.all.")]
    for metric in ("ssim_zero", "psnr_gain_db", "ssim_objects"):
        assert any(m.id == f"views.all.{metric}" for m in numbers), metric
    for number in numbers:
        if number.id != "views.all.lpips" and "depth" not in number.id:
            assert "44 x 36" in number.definition
            assert "split every 8th frame" in number.definition


@pytest.fixture
def run(tmp_path: Path, load_golden_script: Callable[[str], ModuleType]) -> RunFolder:
    run = RunFolder.create(tmp_path / "run")
    load_golden_script("evaluation_others").write_views(run, np.random.default_rng(1))
    return run


@pytest.fixture
def scored(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many views were scored, each time."""
    counts: list[int] = []
    really = views.score_views

    def noted(images: object, **asked: object) -> object:
        found = really(images, **asked)  # type: ignore[arg-type]
        counts.append(len(found))
        return found

    monkeypatch.setattr(views, "score_views", noted)
    return counts


def again(run: RunFolder) -> Comparison:
    with SummaryCache(run.results_dir / FOLDER) as cache:
        return compare_run(run, cache=cache)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_views_are_scored_once_and_again_when_they_change(
    run: RunFolder, scored: list[int], load_golden_script: Callable[[str], ModuleType]
) -> None:
    results = [again(run), again(run), compare_run(run)]
    assert scored == [6, 6]  # the first time, and without a cache
    texts = [write_results(r.results(), run.path / "r.json").read_bytes() for r in results]
    assert texts[0] == texts[1] == texts[2]
    next(iter(run.derived())).unlink()
    load_golden_script("evaluation_others").write_views(run, np.random.default_rng(2))
    other = again(run)
    assert scored == [6, 6, 6]
    assert other.results().get("views.all.psnr_db") != results[0].results().get("views.all.psnr_db")


def test_what_cannot_be_scored_keeps_its_reason(run: RunFolder, scored: list[int]) -> None:
    with SummaryCache(run.results_dir / FOLDER) as cache:
        first = compare_run(run, cache=cache)
        for key in cache._of(ViewScore).rows:
            cache.keep(ViewScore, key, (ViewScore(reason="camera front at 1 ns: no picture"),))
    found = again(run)
    assert len(first.exclusions) + 1 == len(found.exclusions)
    assert any(e.reason == "camera front at 1 ns: no picture" for e in found.exclusions)
    assert scored == [6]
