"""Which trial comes first, and the picture of the moment it went wrong."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from visible import words

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.exchange.reviews import Review
from bridge.media.color import decode_color
from dashboards import queue_page
from dashboards.comparison import judge
from dashboards.queue_page import build_queue, moment_of, recorded_trials, thumbnail
from evaluator.review_index import severity

CARRIED_NS = 2_800_000_000
"""Into the plan: when the twin drops the cube in the synthetic refusals."""


@pytest.fixture
def disagreement(synthetic: ModuleType, tmp_path: Path) -> RunFolder:
    """Return one trial that succeeded, of which the twin says that it fails."""
    run = RunFolder.create(tmp_path / "run")
    synthetic.write_trial(run, synthetic.TRIALS[1])
    synthetic.write_replay(run, synthetic.TRIALS[1], "planned", False)
    return run


def test_a_wrong_yes_comes_before_a_wrong_no_and_far_before_near(shared_run: RunFolder) -> None:
    (row, *_) = judge(shared_run).rows
    answers = {  # recorded, twin, distance
        "near": (True, True, 0.01),
        "far": (True, True, 0.03),
        "nobody": (None, True, 0.5),
        "wrong_no": (True, False, 0.02),
        "wrong_yes": (False, True, 0.01),
    }
    rows = [
        replace(row, episode=name, recorded=recorded, sim_planned=twin, distance_m=far)
        for name, (recorded, twin, far) in answers.items()
    ]
    of_a_table = replace(rows[0], episode="no recording", file="")
    trials = tuple(sorted([of_a_table, *rows], key=severity))
    found: Any = SimpleNamespace(rows=trials, only_motions=False)
    assert [each.episode for each in recorded_trials(found)] == [
        *("wrong_yes", "wrong_no", "nobody", "far", "near")
    ]
    assert [severity(each)[0] for each in recorded_trials(found)] == [0, 1, 2, 3, 3]
    flag = [Review(trial_id="near", rater="Ann", result="unrated", flag=True)]
    shown = {
        show: [
            item.row.episode
            for item in build_queue(shared_run, found, (flag, ()), show=show, page=1).items
        ]
        for show in queue_page.SHOW
    }
    assert shown["diverged"] == ["nobody", "far", "wrong_no", "wrong_yes", "near"]
    assert shown["wrong_yes"] == ["wrong_yes"]
    assert shown["disagree"] == ["wrong_yes", "wrong_no"]
    assert shown["flagged"] == ["near"]
    page = build_queue(shared_run, found, (flag, ()), show="", page=99)
    assert (page.page, page.num_pages) == (1, 1)
    assert {item.row.episode: item.num_labels for item in page.items}["near"] == 0


def test_a_picture_shows_the_instant_at_which_the_twin_fails(disagreement: RunFolder) -> None:
    (row,) = judge(disagreement).rows
    moment = moment_of(disagreement, row)
    assert moment is not None
    assert (moment.t_ns, moment.text) == (CARRIED_NS, "the cube left the gripper during carry")
    image = decode_color(thumbnail(disagreement, row)).astype(int)
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
    (row,) = judge(disagreement).rows
    moment = moment_of(disagreement, replace(row, executed_replay="other.mcap"))
    assert moment is not None
    assert (moment.t_s, moment.text) == (1.5, "cube lies 69 mm apart")


def test_a_picture_is_drawn_once_and_again_when_the_recording_changes(
    disagreement: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    (row,) = judge(disagreement).rows
    first = thumbnail(disagreement, row)
    folder = disagreement.results_dir / queue_page.THUMBNAILS
    (kept,) = folder.iterdir()
    assert kept.read_bytes() == first
    with monkeypatch.context() as patch:
        patch.setattr(queue_page, "_drawn", lambda *_: b"drawn again")
        assert thumbnail(disagreement, row) == first
        (path,) = disagreement.episodes()
        os.utime(path, ns=(1, 1))
        assert thumbnail(disagreement, row) == b"drawn again"
    assert [each.read_bytes() for each in folder.iterdir()] == [b"drawn again"]


def test_the_queue_page_leads_to_each_trial_and_says_why(browser: Any) -> None:
    answer = browser.get("/queue")
    assert answer.status_code == 200
    ids = list(dict.fromkeys(re.findall(r'href="/episode/(trial_\d+)', answer.text)))
    assert ids[0] == "trial_0002"
    assert sorted(ids) == ["trial_0001", "trial_0002", "trial_0003", "trial_0004"]
    text = words(answer.text)
    assert "wrong no: the twin fails, the trial succeeded" in text
    assert "at 3.80 s : the cube left the gripper during carry" in text
    picture = browser.get("/queue/thumbnail/trial_0002")
    assert picture.headers["content-type"] == "image/jpeg"
    for address in ("/queue/thumbnail/..%2F..%2Fx", "/queue/thumbnail/scan"):
        assert browser.get(address).status_code == 404
    for query in ("page=x", "page=-1", "page=999999999999", "show=<script>", "page=%C2%B2"):
        assert browser.get(f"/queue?{query}").status_code == 200


def test_hostile_names_are_shown_as_text(synthetic: ModuleType, tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    name = '<script>alert("1")</script>'.replace("/", "∕") + "'\n" + "x" * 100
    nasty = f"</p>{name}" + "y" * 400
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(EpisodeInfo(id=name, kind="trial", task=nasty, instruction=nasty))
    browser = synthetic.browser_of(run)
    for address in ("/queue", f"/label?rater={'<b>Ann</b>'}"):
        answer = browser.get(address, follow_redirects=True)
        assert answer.status_code == 200
        assert "<script>alert" not in answer.text
        assert "</p>&lt;" not in answer.text
        assert "<b>Ann" not in answer.text
    body = {"trial_id": name, "seen": "", "result": "success", "note": nasty}
    assert browser.post("/label?rater=%3Cb%3EAnn", json=body).status_code == 200
    (kept,) = (run.path / "reviews").iterdir()
    assert json.loads(kept.read_text())["note"] == nasty
    assert "<script>alert" not in browser.get("/reviews?show=1").text
