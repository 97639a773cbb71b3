"""An import of motions: the page draws what the evaluator keeps, recorded beside simulators."""

import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from test_review_index import HOSTILE
from visible import words

from bridge.episode import schema
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from dashboards.band_charts import band_groups
from dashboards.comparison import judge
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


def test_the_page_draws_every_side_in_its_own_look(imported: RunFolder, synthetic: Any) -> None:
    text = synthetic.browser_of(imported).get("/").text
    seen = words(text)
    assert "push: how the tool moved" in seen
    assert "push: how cup moved" in seen
    for legend in ("recorded (3)", "good (2)", "flat (1)"):
        assert legend in seen
    looks = set(re.findall(r'<polyline class="line ([\w-]+)"', text))
    assert looks == {"recorded", "engine-0", "engine-1", "axis", "shadow"}
    assert text.count('class="reach"') == 1 + 2 * 3  # distance, and x, y, z of tool and cup
    about = judge(imported).about
    tool, cup = band_groups(about)
    assert [chart.title for chart in tool.charts] == [
        "Distance from the recorded mean [mm]",
        *(f"{axis} of the base frame [mm]" for axis in "xyz"),
        "Path, from above: y over x [mm]",
        "Path, side: z over x [mm]",
        "Path in space [mm]",
    ]
    x = cup.charts[0]
    drawn = {line.name: [p.split(",") for p in line.points.split(" ")] for line in x.lines}
    ends = {name: (float(points[0][1]), float(points[-1][1])) for name, points in drawn.items()}
    assert ends["flat"][0] == ends["flat"][1]
    assert ends["recorded"][1] < ends["recorded"][0]  # up is less in pixels
    assert ends["recorded"][1] == pytest.approx(x.y.px(691), abs=2)


def test_a_view_has_one_scale_for_both_axes(imported: RunFolder) -> None:
    for group in band_groups(judge(imported).about):
        for chart in group.charts[-3:]:
            across = abs(chart.x.px_high - chart.x.px_low) / (chart.x.high - chart.x.low)
            up = abs(chart.y.px_high - chart.y.px_low) / (chart.y.high - chart.y.low)
            assert across == pytest.approx(up)


def test_in_space_what_moves_along_x_runs_along_that_axis(imported: RunFolder) -> None:
    _, cup = band_groups(judge(imported).about)
    chart = cup.charts[-1]
    lines = {
        line.name: [tuple(map(float, p.split(","))) for p in line.points.split(" ")]
        for line in chart.lines
    }

    def direction(name: str) -> np.ndarray:
        along = np.subtract(lines[name][-1], lines[name][0])
        return along / np.linalg.norm(along)

    np.testing.assert_allclose(direction("recorded"), direction("axis x"), atol=0.01)
    np.testing.assert_allclose(direction("axis z"), [0, -1], atol=0.01)
    assert np.ptp(lines["flat"], axis=0) == pytest.approx([0, 0])
    assert [text for _, _, text in chart.labels] == ["x", "y", "z"]
    assert re.match(r"x 50\d to (69\d|700), y ", chart.x_name)


def test_hostile_tasks_and_engines_are_text(synthetic: ModuleType, tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    _write(run, "real", HOSTILE[:200], "", 0.0)
    _write(run, "sim", HOSTILE[:200], "engine:<b>x</b>", 0.0)
    text = synthetic.browser_of(run).get("/").text
    assert "<script>alert" not in text
    assert "<b>x" not in text
    assert "how the tool moved" in text


def test_a_run_of_trials_keeps_no_paths(shared_run: RunFolder) -> None:
    assert "paths" not in judge(shared_run).about
    assert band_groups(judge(shared_run).about) == ()


@pytest.mark.parametrize("page", ["/queue", "/failures", "/twin"])
def test_pages_of_trials_do_not_ask_motions_for_trials(
    synthetic: ModuleType, imported: RunFolder, page: str
) -> None:
    text = words(synthetic.browser_of(imported).get(page).text)
    assert ("This run holds imported motions and no trial" in text) == (page != "/twin")
    for asked in ("No trials yet", "holds no trial yet", "robot-gst rebuild", "robot-gst record"):
        assert asked not in text
