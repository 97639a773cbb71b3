"""What the page of held-out views holds, without a browser."""

from dataclasses import replace
from types import ModuleType

import pytest
from serving import judged

from bridge.episode.run_folder import RunFolder
from dashboards.errors import NotHereError
from dashboards.twin_page import build_twin, view_image
from evaluator.compare.images.views import VIEWS_TITLE
from evaluator.result import Table, load_results, write_results

COLUMNS = ("camera", "stamp_ns", "PSNR (dB)", "SSIM")


def rate(run: RunFolder, psnr_db: list[float | None]) -> None:
    """Let the results rate the first views, in the order in which they were recorded."""
    results = load_results(run.path)
    (path,) = run.derived("*.views.*")
    views = sorted(build_twin(run, judged(run)).views, key=lambda view: view.stamp_ns)
    rows = tuple((v.camera, v.stamp_ns, db, 0.8) for v, db in zip(views, psnr_db, strict=False))
    title = VIEWS_TITLE + path.stem
    table = Table(id="views_0", title=title, columns=COLUMNS, rows=rows)
    tables = (table,) if psnr_db else ()
    write_results(replace(results, tables=tables), run.results_dir / "results.json")


def test_rated_views_come_worst_first_and_unrated_ones_last(copy: RunFolder) -> None:
    rate(copy, [25.0, 18.0])
    page = build_twin(copy, judged(copy))
    assert [view.psnr_db for view in page.views] == [18.0, 25.0, None]
    assert [view.ssim for view in page.views] == [0.8, 0.8, None]
    assert page.rated


def test_views_without_scores_are_shown_in_recorded_order(copy: RunFolder) -> None:
    rate(copy, [])
    page = build_twin(copy, judged(copy))
    assert not page.rated
    stamps_ns = [view.stamp_ns for view in page.views]
    assert stamps_ns == sorted(stamps_ns)
    assert {view.camera for view in page.views} == {"side"}


def test_both_sides_of_a_view_are_images_and_a_third_side_is_refused(
    shared_run: RunFolder,
) -> None:
    view = build_twin(shared_run, judged(shared_run)).views[0]
    path = shared_run.derived_dir / view.file
    for side in ("recorded", "rendered"):
        data, kind = view_image(shared_run, path, side, view.camera, view.stamp_ns)
        assert data.startswith(b"\xff\xd8")
        assert kind == "image/jpeg"
    with pytest.raises(NotHereError, match="neither recorded nor rendered"):
        view_image(shared_run, path, "top", view.camera, view.stamp_ns)


def test_a_view_whose_recording_is_gone_says_so(own_run: RunFolder, synthetic: ModuleType) -> None:
    other = synthetic.write_views(own_run, source="elsewhere")
    with pytest.raises(NotHereError, match="was made from is not in this run"):
        view_image(own_run, other, "recorded", "wrist", 0)
