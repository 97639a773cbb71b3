"""Failures sorted by what twin and labels say, the moment at which they happen, its picture."""

import io
import json
import os
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

from bridge.episode.metadata import ROLLOUT, EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import decode_color
from dashboards import clips, moments
from dashboards.failures_page import PART_WORDS
from dashboards.moments import Cause, cause_of, moment_of
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


CARRIED_NS = 2_800_000_000
"""Into the plan: when the twin drops the cube in the synthetic refusals."""


def test_a_picture_shows_the_instant_at_which_the_twin_fails(disagreement: RunFolder) -> None:
    (row,) = judged(disagreement).rows
    moment = moment_of(disagreement, row)
    assert moment is not None
    assert (moment.t_ns, moment.text) == (CARRIED_NS, "the cube left the gripper during carry")
    image = decode_color(clips.picture(disagreement, row)).astype(int)
    red = (image[..., 0] - image[..., 1] > 90) & (image[..., 0] - image[..., 2] > 90)
    centre_px = np.nonzero(red)[1].mean() / image.shape[1] * 160
    # The synthetic cube moves 16 pixels a second; the plan starts 1 s into the recording, and
    # there is a picture every quarter of a second.
    assert centre_px == pytest.approx(20 + 9 + 16 * (1 + CARRIED_NS * 1e-9), abs=16 * 0.125 + 1)


def test_the_divergence_that_a_replay_tells_comes_before_its_verdict(
    disagreement: RunFolder, synthetic: ModuleType
) -> None:
    trial = synthetic.TRIALS[1]
    path = synthetic.write_replay(disagreement, trial, "executed", False)
    plan_id = synthetic.make_plan(trial).id
    with EpisodeWriter(path.with_name("other.mcap")) as writer:
        synthetic.write_divergence(writer, plan_id, ("planned", "executed"), 1_500_000_000)
    (row,) = judged(disagreement).rows
    moment = moment_of(disagreement, replace(row, executed_replay="other.mcap"))
    assert moment is not None
    assert (moment.t_s, moment.text) == (1.5, "cube lies 69 mm apart")


def test_a_disagreement_has_a_cause_a_margin_and_says_how_often_it_happens(
    disagreement: RunFolder, synthetic: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    (row,) = judged(disagreement).rows
    dropped = "the cube left the gripper during carry"
    told = Cause(text=dropped, margin=dropped, varied=None, goes_with={})
    assert cause_of(disagreement, row) == told
    assert cause_of(disagreement, replace(row, recorded=False)) is None
    rolled = replace(row, plan_id=ROLLOUT, sim_executed=row.recorded)
    moved = cause_of(disagreement, rolled)
    assert moved is not None
    assert moved.text == f"The policy moved otherwise in the twin: {dropped}"
    same = cause_of(disagreement, replace(rolled, sim_executed=not row.recorded))
    assert same is not None
    assert same.text == f"The same motion ends otherwise in the twin: {dropped}"
    said = synthetic.make_verdict("p", True, "planned", "bullet")
    said = replace(
        said,
        terminal=replace(said.terminal, detail="2 mm within the box; it is still"),
        p_success={"k": 4, "n": 8, "value": 0.5, "low": 0.2, "high": 0.8},
    )
    ends = [True, False] * 12
    kept = replace(
        said,
        samples={
            "accepted": ends,
            "cause": ["" if each else "inside" for each in ends],
            "missed_m": [None if each else 0.0021 for each in ends],
            "drawn": {"cube along x m": [(2 if each else -3) * 1e-3 for each in ends]},
        },
    )
    browser = synthetic.browser_of(disagreement)
    for address in ("/", "/episode/trial_0002"):
        assert "varied nothing was varied" in words(browser.get(address).text)
        with monkeypatch.context() as patch:
            patch.setattr(moments, "_verdict_of", lambda *_: said)
            text = words(browser.get(address).text)
            assert "margin 2 mm within the box varied 4 of 8 varied replays succeed" in text
            assert "what they varied was not kept: replay once more" in text
            patch.setattr(moments, "_verdict_of", lambda *_: kept)
            page = browser.get(address).text
            assert "margin with 3 mm more 24 of 24 varied replays would succeed" in words(page)
            assert "cube along x: +2.0 mm where it succeeds, -3.0 mm where not" in words(page)
            assert 'aria-label="strength 1.00 of 1"><rect width="72"' in page


def test_a_picture_is_drawn_once_and_again_when_the_recording_changes(
    disagreement: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    (row,) = judged(disagreement).rows
    first = clips.picture(disagreement, row)
    folder = disagreement.results_dir / clips.PICTURES
    (kept,) = folder.iterdir()
    assert kept.read_bytes() == first
    with monkeypatch.context() as patch:
        patch.setattr(clips, "encode_jpeg", lambda *_, **__: b"drawn again")
        assert clips.picture(disagreement, row) == first
        (path,) = disagreement.episodes()
        os.utime(path, ns=(1, 1))
        assert clips.picture(disagreement, row) == b"drawn again"
    assert [each.read_bytes() for each in folder.iterdir()] == [b"drawn again"]


def test_hostile_names_are_shown_as_text(synthetic: ModuleType, run: RunFolder) -> None:
    name = '<script>alert("1")</script>'.replace("/", "∕") + "'\n" + "x" * 100
    nasty = f"</p>{name}" + "y" * 400
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(EpisodeInfo(id=name, kind="trial", task=nasty, instruction=nasty))
    browser = synthetic.browser_of(run)
    for address in ("/failures", f"/label?rater={'<b>Ann</b>'}"):
        answer = browser.get(address, follow_redirects=True)
        assert answer.status_code == 200
        assert "<script>alert" not in answer.text
        assert "</p>&lt;" not in answer.text
        assert "<b>Ann" not in answer.text
    body = {"trial_id": name, "seen": "", "result": "success", "note": nasty}
    assert browser.post("/label?rater=%3Cb%3EAnn", json=body).status_code == 200
    (kept,) = (run.path / "reviews").iterdir()
    assert json.loads(kept.read_text())["note"] == nasty
    assert "<script>alert" not in browser.get("/label?show=1").text
