"""Failures are sorted by what the twin and the labels say, and shown at the moment they happen."""

import io
import re
from collections import Counter
from dataclasses import replace
from itertools import combinations
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from serving import judged
from test_review_index import HOSTILE, made, many
from visible import words

from bridge.episode.run_folder import RunFolder
from bridge.media.color import decode_color
from dashboards import clips
from dashboards.failures_page import PART_WORDS
from evaluator.compare.failures import (
    NO_ANSWER,
    TWIN_SUCCEEDS,
    failure_kind,
    start_regions,
)
from evaluator.compare.rows import TrialRow
from evaluator.review_index import FAILURE_PARTS, NOT_KNOWN, FailureSelection

ROW = TrialRow(
    episode="e", task="pour", condition="", policy="", start_id=None, cell="", stand_in=None,
    recorded=None,
)  # fmt: skip


@pytest.mark.parametrize(
    ("recorded", "planned", "stages", "expected"),
    [
        (True, True, (), None),
        (None, None, (), None),
        (True, False, (), "dropped, carry, cube and table"),
        (False, False, (), "dropped, carry, cube and table"),
        (False, False, (("grasp", False),), "dropped, grasp, cube and table"),
        (False, False, (("grasp", True),), "dropped, carry, cube and table"),
        (False, True, (("grasp", True), ("lift", False)), f"{TWIN_SUCCEEDS}, lift, "),
        (False, None, (), f"{NO_ANSWER}, , "),
    ],
)
def test_a_failure_is_named_by_the_twin_and_its_stage_by_a_label_where_there_is_one(
    recorded: bool | None,
    planned: bool | None,
    stages: tuple[tuple[str, bool], ...],
    expected: str | None,
) -> None:
    row = replace(
        ROW,
        recorded=recorded,
        sim_planned=planned,
        stages=stages,
        first_failing="terminal",
        failing_cause="dropped",
        failing_stage="carry",
        failing_bodies=("table", "cube"),
    )
    kind = failure_kind(row)
    assert (kind and f"{kind.cause}, {kind.stage}, {kind.bodies}") == expected


def _starts(p_m: np.ndarray, task: str = "pour") -> list[TrialRow]:
    still = (0.5, 0.1, 0.0)
    return [
        replace(
            ROW,
            episode=f"{task} {i}",
            task=task,
            start_positions_m={"cup": tuple(p), "table": still},
        )
        for i, p in enumerate(p_m.tolist())
    ]


def test_every_part_of_a_failure_has_its_word() -> None:
    assert PART_WORDS.keys() == set(FAILURE_PARTS)


def test_start_regions_are_halves_wherever_the_robot_stands() -> None:
    x, y = np.meshgrid([0.3, 0.5], [-0.2, 0.2])
    p_m = np.stack([x.ravel(), y.ravel(), np.zeros(4)], axis=1)
    expected = ["cup near right", "cup far right", "cup near left", "cup far left"]
    for shift in (0.0, 1.7):
        assert list(start_regions(_starts(p_m + shift)).values()) == expected
    narrow = p_m * [0.01, 1, 1]
    assert set(start_regions(_starts(narrow)).values()) == {"cup left", "cup right"}
    assert start_regions(_starts(p_m * 0.01)) == {}
    assert start_regions(_starts(p_m[:3])) == {}
    both = start_regions([*_starts(p_m), *_starts(p_m + 5, "stack")])
    assert list(both.values()) == expected * 2


def failures() -> list[TrialRow]:
    causes, bodies = ("dropped", HOSTILE, "unreachable"), ("cube and table", "", HOSTILE)
    return [
        replace(
            trial,
            fail_cause=causes[number % 3] if False in (trial.recorded, trial.sim_planned) else "",
            fail_stage="grasp" if number % 4 else "",
            fail_bodies=bodies[number % 5 % 3],
            start_region=("cup near", "cup far")[number % 2],
        )
        for number, trial in enumerate(many())
    ]


@pytest.mark.parametrize("num_parts", [1, 2, 4])
def test_groups_count_every_failure_once(num_parts: int) -> None:
    trials, index = failures(), made(failures())
    for parts in combinations(FAILURE_PARTS, num_parts):
        for narrowed in ({}, {"stage": "grasp"}, {"bodies": HOSTILE}, {"bodies": NOT_KNOWN}):
            selection = FailureSelection(by=".".join(parts), **narrowed)
            kept = [
                t
                for t in trials
                if t.fail_cause
                and all(
                    getattr(t, FAILURE_PARTS[name]) == ("" if value == NOT_KNOWN else value)
                    for name, value in narrowed.items()
                )
            ]
            expected = Counter(
                tuple(getattr(t, FAILURE_PARTS[part]) for part in parts) for t in kept
            )
            groups = index.failure_groups(selection)
            assert {tuple(g.parts.values()): g.count for g in groups} == expected
            assert [g.count for g in groups] == sorted(expected.values(), reverse=True)
            assert sum(g.recorded for g in groups) == sum(t.recorded is False for t in kept)
            assert sum(g.twin for g in groups) == sum(t.sim_planned is False for t in kept)
            group = groups[0]
            query = selection.query(**{k: v or NOT_KNOWN for k, v in group.parts.items()})
            shown = index.trials(FailureSelection(**query), limit=1000)
            assert len(shown) == group.count
            assert list(shown) == [t for t in trials if t in shown]


def test_who_failed_parts_the_failures() -> None:
    index = made(failures())
    counts = {
        failed: sum(g.count for g in index.failure_groups(FailureSelection(failed=failed)))
        for failed in ("", "foretold", "wrong_yes", "wrong_no", "nonsense")
    }
    parts = [counts[name] for name in ("foretold", "wrong_yes", "wrong_no")]
    assert counts[""] == sum(parts)
    assert all(parts)
    assert counts["nonsense"] == 0


def test_the_page_groups_the_run_and_leads_to_each_trial(browser: Any) -> None:
    text = browser.get("/failures").text
    seen = words(text)
    assert "2 failures 1 kind" in seen
    assert "dropped × carry × cube and table" in seen
    assert "failed: 1 recorded, 2 in the twin" in seen
    assert re.findall(r'class="pair" href="(.*?)"', text) == [
        "/episode/trial_0002",
        "/episode/trial_0001",
    ]
    assert "No failure matches" in browser.get("/failures?cause=%3Cscript%3E").text
    for query in ("by=nonsense", "by=cause..stage", "page=x", "page=999999999", "failed=%27"):
        assert browser.get(f"/failures?{query}").status_code == 200
    for kind in ("picture", "clip"):
        for name in ("..%2F..%2Fx", "scan", "nobody"):
            assert browser.get(f"/failures/{kind}/{name}").status_code == 404


@pytest.fixture
def drawn(synthetic: ModuleType, disagreement: RunFolder) -> RunFolder:
    """Return a disagreement whose planned replay was drawn; the twin's cube lags a second."""
    synthetic.write_drawn(disagreement, synthetic.TRIALS[1], "planned", range(20, 110, 5))
    return disagreement


def _cube_px(image: np.ndarray) -> float:
    """Column of the middle of the red cube, in pixels of the recorded picture."""
    found = image.astype(int)
    red = (found[..., 0] - found[..., 1] > 90) & (found[..., 0] - found[..., 2] > 90)
    return float(np.nonzero(red)[1].mean() * 120 / image.shape[0])


def test_picture_and_clip_show_recorded_beside_twin_at_the_moment(drawn: RunFolder) -> None:
    (row,) = judged(drawn).rows
    found = clips.footage(drawn, row)
    assert found.has_twin
    width = (found.frames[0].shape[1] - clips.GAP_PX) // 2
    moment_s = 1 + 2.8  # the plan starts 1 s into the recording; the twin drops the cube 2.8 s in
    for t_s, frame in zip(found.times_s, found.frames, strict=True):
        recorded, twin = frame[:, :width], frame[:, -width:]
        at = 20 + 9 + 16 * (moment_s + t_s)
        assert _cube_px(recorded) == pytest.approx(at, abs=1.0)
        assert _cube_px(twin) == pytest.approx(at - 16, abs=1.0)
    assert -1.2 <= found.times_s[0] < -0.9
    assert 0.5 < found.times_s[-1] <= 0.8
    key = decode_color(clips.picture(drawn, row))[:, :width]
    assert _cube_px(key) == pytest.approx(20 + 9 + 16 * moment_s, abs=16 * 0.125 + 1)
    av = pytest.importorskip("av")
    with av.open(io.BytesIO(clips.clip(drawn, row))) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert video.streams.video[0].codec_context.name == "h264"
    assert len(frames) == len(found.frames)
    moved = [_cube_px(frame[:, :width]) for frame in frames]
    assert moved == pytest.approx([_cube_px(f[:, :width]) for f in found.frames], abs=1.5)
