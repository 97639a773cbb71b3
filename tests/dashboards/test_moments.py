"""The moment at which a trial went wrong, and its picture."""

import json
import os
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from serving import judged
from visible import words

from bridge.episode.metadata import ROLLOUT, EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import decode_color
from dashboards import clips, moments
from dashboards.moments import Cause, cause_of, moment_of

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


def test_hostile_names_are_shown_as_text(synthetic: ModuleType, tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
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
