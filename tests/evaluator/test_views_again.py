"""Rendered views are scored once: the second evaluation takes what is kept and says the same."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from bridge.episode.run_folder import RunFolder
from evaluator.cache import FOLDER, SummaryCache
from evaluator.compare import Comparison, compare_run
from evaluator.compare.images import views
from evaluator.compare.images.scores import ViewScore
from evaluator.result import write_results


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
