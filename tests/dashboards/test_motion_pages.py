"""An import of motions: pages of trials say so, and the first page has the evaluator's tables."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from test_review_index import HOSTILE
from visible import words

from bridge.episode import schema
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from evaluator.compare import compare_run
from evaluator.compare.band_measurements import PATH_SAMPLES

SIDES = {"": 3, "engine:good": 2, "engine:flat": 1}
"""Tag and number of runs."""


def _write(run: RunFolder, name: str, task: str, tag: str, offset_m: float) -> None:
    """A tool that moves along an arc for 2 s, and pushes a cup only where it is not ``flat``."""
    tags = (tag,) if tag else ()
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(EpisodeInfo(id=name, kind="imported", task=task, tags=tags, robot="arm"))
        for step in range(101):
            share = step / 100
            tool = np.array([0.3 + 0.4 * share, offset_m, 0.2 + 0.1 * np.sin(np.pi * share)])
            pushed = 0.0 if tag == "engine:flat" else 0.2 * share
            for topic, p_m in (
                ("/lab/tcp/pose", tool),
                ("/lab/object/cup/pose", np.array([0.5 + pushed, offset_m, 0.02])),
            ):
                T = np.eye(4)
                T[:3, 3] = p_m
                ns = 1_700_000_000_000_000_000 + step * 20_000_000
                sample = PoseSample(stamp_ns=ns, frame_id="base_link", T_frame_body=T)
                writer.write(
                    topic,
                    sample.to_cdr(),
                    type_name=schema.POSE_STAMPED,
                    log_time_ns=ns,
                    publish_time_ns=ns,
                )


@pytest.fixture
def imported(tmp_path: Path) -> RunFolder:
    run = RunFolder.create(tmp_path / "run")
    for tag, count in SIDES.items():
        for number in range(count):
            name = f"{tag.removeprefix('engine:') or 'real'}_{number}"
            _write(run, name, "push", tag, 0.01 * number)
    return run


def test_paths_are_means_of_the_runs_and_the_reach_holds_each(imported: RunFolder) -> None:
    paths = {(path.body, path.side): path for path in compare_run(imported).paths}
    assert set(paths) == {(b, s) for b in ("tool", "cup") for s in ("recorded", "good", "flat")}
    tool = paths["tool", "recorded"]
    assert tool.num_runs == 3
    mean, low, high = (np.array(part) for part in (tool.mean_m, tool.low_m, tool.high_m))
    assert mean.shape == (PATH_SAMPLES, 3)
    assert mean[:, 1] == pytest.approx(0.01)
    assert low[:, 1] == pytest.approx(0.0)
    assert high[:, 1] == pytest.approx(0.02)
    assert (low <= mean + 1e-12).all()
    assert (mean <= high + 1e-12).all()
    assert mean[0, 0] == pytest.approx(0.3, abs=0.011)  # the first 10 mm count as waiting
    assert mean[-1, 0] == pytest.approx(0.7, abs=0.011)
    flat = np.array(paths["cup", "flat"].mean_m)
    assert np.ptp(flat[:, 0]) == pytest.approx(0.0)


def test_hostile_tasks_and_engines_are_text(synthetic: ModuleType, tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    _write(run, "real", HOSTILE[:200], "", 0.0)
    _write(run, "sim", HOSTILE[:200], "engine:<b>x</b>", 0.0)
    text = synthetic.browser_of(run).get("/").text
    assert "<script>alert" not in text
    assert "<b>x" not in text


@pytest.mark.parametrize("page", ["/queue", "/failures", "/twin"])
def test_pages_of_trials_do_not_ask_motions_for_trials(
    synthetic: ModuleType, imported: RunFolder, page: str
) -> None:
    text = words(synthetic.browser_of(imported).get(page).text)
    assert ("This run holds imported motions and no trial" in text) == (page != "/twin")
    for asked in ("No trials yet", "holds no trial yet", "robot-gst rebuild", "robot-gst record"):
        assert asked not in text
